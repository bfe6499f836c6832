"""What takes long to make, made once for all processes of a run of the tests."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from daemon.store.database import open_store
from daemon.store.sqlite import FILE_NAME


def shared_directory(
    factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], None]
) -> Path:
    """A directory that the first process to want it has filled; not to be changed."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # each process has a folder of its own in that of the run
    directory, done = base / f"shared-{name}", base / f"shared-{name}.done"
    with (base / f"shared-{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            shutil.rmtree(directory, ignore_errors=True)  # of a process that failed in it
            directory.mkdir()
            fill(directory)
            done.touch()
    return directory


def new_state(directory: Path) -> Path:
    """A state directory with an empty database, whose tables are made once in a process."""
    database = directory / FILE_NAME
    directory.mkdir()
    content, mode = empty_database()
    database.write_bytes(content)
    database.chmod(mode)
    return directory


@cache
def empty_database() -> tuple[bytes, int]:
    """Content and mode of a database that all migrations have gone through."""
    with TemporaryDirectory() as directory:
        open_store(Path(directory)).close()
        database = Path(directory) / FILE_NAME
        return database.read_bytes(), database.stat().st_mode
