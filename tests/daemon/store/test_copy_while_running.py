"""Copies of a database that a daemon has open."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from daemon.errors import CopyError, StoreError
from daemon.store.database import open_store, open_store_readonly
from tests.daemon.store.examples import full_record, record, slot


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Path]:
    """A database that a daemon has open, with rows still in the log."""
    with open_store(tmp_path / "state") as store:
        store.add_measurement(full_record(slot(0)))
    with open_store(tmp_path / "state") as store:
        store.add_measurement(record(slot(1)))
        yield tmp_path / "state"


def test_a_backup_of_a_running_database_is_whole_and_one_file(
    running: Path, tmp_path: Path
) -> None:
    target = tmp_path / "copies" / "dcam.db"
    target.parent.mkdir()
    target.write_text("an older copy")
    with open_store_readonly(running) as store:
        store.backup(target)
    assert [path.name for path in target.parent.iterdir()] == ["dcam.db"]
    with closing(sqlite3.connect(f"file:{target}?immutable=1", uri=True)) as connection:
        assert connection.execute("SELECT count(*) FROM measurement").fetchone() == (2,)
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    with open_store(target.parent) as store:
        assert store.last_slot() == slot(1)


def test_a_backup_during_a_half_done_write_has_none_of_it(running: Path, tmp_path: Path) -> None:
    with (
        closing(sqlite3.connect(running / "dcam.db", isolation_level=None)) as writer,
        open_store_readonly(running) as store,
    ):
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE measurement SET version = 'half done'")
        store.backup(tmp_path / "copy.db")
    with closing(sqlite3.connect(tmp_path / "copy.db")) as connection:
        found = connection.execute("SELECT DISTINCT version FROM measurement").fetchall()
    assert found == [("0.1.0",)]


def test_a_backup_that_cannot_be_written_leaves_the_older_one(
    running: Path, tmp_path: Path
) -> None:
    with open_store_readonly(running) as store:
        with pytest.raises(StoreError, match="is the database itself"):
            store.backup(running / "dcam.db")
        with pytest.raises(CopyError, match="nowhere"):
            store.backup(tmp_path / "nowhere" / "copy.db")
        (tmp_path / "taken" / "inside").mkdir(parents=True)
        with pytest.raises(CopyError, match="taken: cannot write the backup"):
            store.backup(tmp_path / "taken")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["state", "taken"]
