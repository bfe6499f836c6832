"""Log and journal beside a database: what a cut leaves is no damage, the rest is noticed."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from daemon.store.damage_note import databases_set_aside
from daemon.store.database import open_store
from daemon.store.opening import open_checked_store
from tests.daemon.store.damaged import opened_and_read, rows_of, wrong
from tests.daemon.store.examples import (
    record,
    slot,
)


@contextmanager
def killed_while_it_ran(state: Path, more: int) -> Iterator[list[int]]:
    """A database whose last rows are in its log only; gives where each commit ends in it."""
    ends = []
    with open_store(state / "live") as store:
        store.add_measurement(record(slot(0)))
        for number in range(1, more):
            store.add_measurement(record(slot(number)))
            ends.append((state / "live" / "dcam.db-wal").stat().st_size)
        for path in (state / "live").iterdir():
            shutil.copy(path, state)
    yield ends


def test_rows_behind_a_damaged_part_of_the_log_are_not_lost(tmp_path: Path) -> None:
    """SQLite alone would drop them without a word."""
    with killed_while_it_ran(tmp_path, 30) as ends:
        log = bytearray((tmp_path / "dcam.db-wal").read_bytes())
        log[ends[9] + 2000] ^= 4
        (tmp_path / "dcam.db-wal").write_bytes(log)
    with open_checked_store(tmp_path) as store:
        (event,) = store.events(kind="database_salvaged")
        assert "the log is damaged: SQLite would drop" in event.detail
        assert len(store.measured_slots()) >= 29
    assert (tmp_path / f"{databases_set_aside(tmp_path)[0].name}-wal").read_bytes() == log


def test_a_commit_that_a_cut_left_half_done_is_no_damage(tmp_path: Path) -> None:
    with killed_while_it_ran(tmp_path, 30) as ends:
        log = (tmp_path / "dcam.db-wal").read_bytes()
        (tmp_path / "dcam.db-wal").write_bytes(log[: ends[-2] + 4200] + bytes(9000))
    with open_checked_store(tmp_path) as store:
        assert store.measured_slots() == {slot(number) for number in range(29)}
        assert store.events(kind="database_salvaged") == []


def test_a_rollback_journal_that_a_cut_left_is_undone_and_no_damage(
    state: Path, sound: Path, tmp_path: Path
) -> None:
    """A copy of a database, or one that is just being made, has a journal before it has a log."""
    cut = tmp_path / "cut"
    cut.mkdir()
    with closing(sqlite3.connect(state / "dcam.db", isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")
        connection.execute("PRAGMA cache_size=1")
        connection.execute("BEGIN")
        connection.execute("UPDATE measurement SET version = 'half done'")
        for name in ("dcam.db", "dcam.db-journal"):
            shutil.copy(state / name, cut)
    for opener in (open_store, open_checked_store):
        again = Path(shutil.copytree(cut, tmp_path / opener.__name__))
        opener(again).close()
        assert (
            rows_of(again / "dcam.db")["measurement"] == rows_of(sound / "dcam.db")["measurement"]
        )
        assert databases_set_aside(again) == []


def test_the_log_of_another_database_takes_nothing_away(state: Path, sound: Path) -> None:
    """A file was put in place, the old one's log stayed: SQLite would write that over the file."""
    with open_store(state / "other") as other:
        for number in range(5000, 5040):
            other.add_measurement(record(slot(number)))
        shutil.copy(other.path.with_name("dcam.db-wal"), state)
    true = rows_of(sound / "dcam.db")
    opened_and_read(state)
    found = rows_of(state / "dcam.db")
    assert wrong(found, true) == 0
    assert found["measurement"] == true["measurement"]
    assert len(databases_set_aside(state)) == 1
