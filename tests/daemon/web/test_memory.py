"""How much memory dcam-web takes as its unit runs it, beside a measurement that needs its own."""

from __future__ import annotations

from pathlib import Path
from urllib.request import urlopen

from benchmarks.page_server import rss_mb, running
from daemon.store.database import open_store
from tests.daemon.web.site import fill
from tests.waiting import wait_for

MOST_MB = 60.0


def test_at_rest_it_takes_less_than_60_mb(tmp_path: Path) -> None:
    """A second start: byte code is there, as the installation has it."""
    config, state = Path("benchmarks/small.toml").absolute(), tmp_path / "state"
    with open_store(state) as store:
        fill(store)
    for start in (1, 2):
        with running(config, state) as (process, url):
            with urlopen(f"{url}/api/site") as answer:  # once the record is read
                assert answer.status == 200
            if start == 2:
                wait_for(lambda: rss_mb(process) < MOST_MB, f"less than {MOST_MB} MB")
