"""Where crashes are tried."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.crash.lossy_fs import LossyMount, why_not

MEMORY = Path("/dev/shm")


@pytest.fixture(scope="session")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A directory in memory, where there is one: thousands of recoveries sync a lot."""
    place = MEMORY if MEMORY.is_dir() else tmp_path_factory.getbasetemp()
    with TemporaryDirectory(dir=place, prefix="dcam-crash-") as directory:
        yield Path(directory)


@pytest.fixture(scope="session")
def mount(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LossyMount]:
    """The lossy file system."""
    obstacle = why_not()
    if obstacle:
        pytest.skip(obstacle)
    with LossyMount(tmp_path_factory.mktemp("lossy")) as mounted:
        yield mounted
