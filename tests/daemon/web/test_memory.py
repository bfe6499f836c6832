"""How much memory dcam-web takes as its unit runs it, beside a measurement that needs its own."""

from __future__ import annotations

from pathlib import Path
from urllib.request import urlopen

from benchmarks.page_server import own_mb, running
from daemon.store.database import open_store
from tests.daemon.web.site import fill
from tests.waiting import wait_for

MOST_MB = 37.0
"""Without what the unit says, it is 37.7. The pages of libraries that the kernel keeps beside it,
24 to 30 MB, depend on what else runs, and dcamd shares them."""


def test_at_rest_it_takes_little_memory_of_its_own(tmp_path: Path) -> None:
    """A second start: byte code is there, as the installation has it."""
    config, state = Path("benchmarks/small.toml").absolute(), tmp_path / "state"
    with open_store(state) as store:
        fill(store)
    for start in (1, 2):
        with running(config, state) as (process, url):
            with urlopen(f"{url}/api/site") as answer:  # once the record is read
                assert answer.status == 200
            if start == 2:
                wait_for(lambda: own_mb(process) < MOST_MB, f"less than {MOST_MB} MB")
