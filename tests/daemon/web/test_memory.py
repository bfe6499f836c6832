"""How much memory dcam-web takes as its unit runs it, beside a measurement that needs its own."""

from __future__ import annotations

from pathlib import Path
from urllib.request import urlopen

import pytest

from benchmarks.page_server import own_mb, rss_mb, running
from tests.daemon.web.site import copy_record
from tests.waiting import wait_for

MOST_MB = 37.0
"""Without what the unit says, it is 37.7."""
MOST_WITH_LIBRARIES_MB = 55.0
"""48 to 50; with the pages of libraries that only the start needed, it would be 58 to 62."""


def test_at_rest_it_takes_little_memory_of_its_own(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    """A second start: byte code is there, as the installation has it."""
    config, state = Path("benchmarks/small.toml").absolute(), tmp_path / "state"
    copy_record(tmp_path_factory, tmp_path)
    for start in (1, 2):
        with running(config, state) as (process, url):
            with urlopen(f"{url}/api/site") as answer:  # once the record is read
                assert answer.status == 200
            if start == 2:
                wait_for(lambda: own_mb(process) < MOST_MB, f"less than {MOST_MB} MB")
                wait_for(
                    lambda: rss_mb(process) < MOST_WITH_LIBRARIES_MB,
                    f"less than {MOST_WITH_LIBRARIES_MB} MB with libraries",
                )
