"""The lossy file system keeps what was synced, and loses the rest as real ones may."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.crash.disk import Cut, Disk, Tree
from tests.crash.lossy_fs import LossyMount

OLD, NEW = b"old " * 1000, b"new " * 1000


def sync(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    os.fsync(file)
    os.close(file)


class Place:
    """A directory with a file, both safe; what is done from now on is not."""

    def __init__(self, mount: LossyMount, name: str) -> None:
        mount.take()
        self._mount, self._disk = mount, Disk()
        self.directory = mount.directory / name
        self.directory.mkdir()
        self.file.write_bytes(OLD)
        for path in (self.file, self.directory, mount.directory):
            sync(path)

    @property
    def file(self) -> Path:
        return self.directory / "file"

    def replace_file(self, *, synced: bool) -> None:
        temporary = self.directory / "temporary"
        temporary.write_bytes(NEW)
        if synced:
            sync(temporary)
        temporary.replace(self.file)

    def left_by(self, cut: Cut, seed: int = 0) -> Tree:
        """What a cut now would leave in the directory."""
        for operation in self._mount.take():
            self._disk.do(operation)
        start, tree = f"{self.directory.name}/", self._disk.left_by(cut, seed)
        return {path.removeprefix(start): tree[path] for path in tree if path.startswith(start)}


@pytest.fixture
def place(mount: LossyMount, request: pytest.FixtureRequest) -> Place:
    return Place(mount, request.node.name)


def test_what_is_not_synced_is_lost(place: Place) -> None:
    place.replace_file(synced=True)
    assert place.left_by(Cut.LOST) == {"file": OLD}
    assert place.left_by(Cut.KILLED) == {"file": NEW}
    sync(place.directory)
    assert place.left_by(Cut.LOST) == {"file": NEW}


def test_a_name_without_its_content_is_an_empty_file(place: Place) -> None:
    place.replace_file(synced=False)
    sync(place.directory)
    assert place.left_by(Cut.LOST) == {"file": b""}
    assert place.left_by(Cut.NAMES) == {"file": b""}


def test_a_removed_file_is_back_until_its_directory_is_synced(place: Place) -> None:
    place.file.unlink()
    assert place.left_by(Cut.LOST) == {"file": OLD}
    sync(place.directory)
    assert place.left_by(Cut.LOST) == {}


def test_a_write_may_be_torn_at_every_sector(place: Place) -> None:
    with place.file.open("r+b") as file:
        file.write(NEW)
    found = {place.left_by(Cut.TORN, seed)["file"] for seed in range(40)}
    assert {OLD, NEW} < found
    torn = found - {OLD, NEW}
    assert torn
    assert all(one[:512] in {OLD[:512], NEW[:512]} for one in torn)


def test_sqlite_keeps_its_log_and_its_locks_on_it(place: Place) -> None:
    with (
        closing(sqlite3.connect(place.directory / "db", isolation_level=None)) as one,
        closing(sqlite3.connect(place.directory / "db", isolation_level=None, timeout=0)) as other,
    ):
        assert one.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",)
        one.execute("CREATE TABLE numbers (n)")
        one.execute("BEGIN IMMEDIATE")
        one.execute("INSERT INTO numbers VALUES (1)")
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            other.execute("BEGIN IMMEDIATE")
        one.execute("COMMIT")
        assert other.execute("SELECT n FROM numbers").fetchall() == [(1,)]
