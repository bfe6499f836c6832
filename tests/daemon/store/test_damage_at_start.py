"""What a start takes for damage and sets aside, and what it leaves alone."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from alembic import command

from daemon.errors import DatabaseDamagedError, DatabaseNewerError
from daemon.store.damage_note import databases_set_aside, note_damage, read_note
from daemon.store.database import open_store, open_store_readonly
from daemon.store.engine import make_engine
from daemon.store.migrate import alembic_config
from daemon.store.opening import open_checked_store
from daemon.store.records import Mark
from tests.daemon.store.damaged import EVERYTHING, rows_of, wrong
from tests.daemon.store.examples import (
    record,
    slot,
)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda path: path.write_bytes(b"Dear bridge\n" * 999), "not a SQLite database"),
        (lambda path: path.write_bytes(path.read_bytes()[:40_000]), "malformed"),
        (lambda path: path.write_bytes(b"SQLite format 3\0" + bytes(9000)), "not a database"),
        (lambda path: (path.write_bytes(b""), (path.parent / "frames").mkdir()), "empty"),
        (lambda path: (path.unlink(), path.mkdir(), (path / "x").touch()), "not a file"),
    ],
    ids=["text", "truncated", "header only", "empty", "directory"],
)
def test_what_is_no_database_is_set_aside_and_reported(
    state: Path, make: Callable[[Path], object], why: str
) -> None:
    make(state / "dcam.db")
    for opener in (open_store, open_store_readonly):
        if why != "empty":
            with pytest.raises(DatabaseDamagedError, match="restart dcamd, it sets"):
                opener(state).close()
    with open_checked_store(state) as store:
        (event,) = store.events(kind="database_salvaged")
        assert event.detail.startswith(why) or why in event.detail
        store.add_measurement(record(slot(9000)))
    (aside,) = databases_set_aside(state)
    assert aside.is_dir() == (why == "not a file")


def test_an_empty_file_where_there_was_nothing_is_no_damage(tmp_path: Path) -> None:
    (tmp_path / "dcam.db").touch()
    with open_checked_store(tmp_path) as store:
        assert store.events() == []
    assert databases_set_aside(tmp_path) == []


def test_a_sound_database_is_left_alone(state: Path) -> None:
    before = rows_of(state / "dcam.db")
    with open_checked_store(state) as store:
        store.set_mark(Mark.CLEAN_STOP_UTC, None)
    note_damage(state, "somebody thought so")
    open_checked_store(state).close()
    after = rows_of(state / "dcam.db")
    assert all(after[table] == before[table] for table in EVERYTHING if table != "mark")
    assert databases_set_aside(state) == []
    assert read_note(state) is None


def test_a_database_of_a_newer_version_is_never_set_aside(state: Path) -> None:
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
        connection.execute("DELETE FROM mark WHERE name = 'schema'")
        connection.commit()
    with pytest.raises(DatabaseNewerError, match="newer version"):
        open_checked_store(state)
    assert databases_set_aside(state) == []


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE alembic_version SET version_num = '0015'",
        "UPDATE sqlite_master SET sql = replace(sql, 'a slot of', 'b slot of')",
        "UPDATE sqlite_master SET sql = replace(sql, 'start_utc', 'start_utd') WHERE name = 'gap'",
    ],
    ids=["revision", "trigger", "table"],
)
def test_a_definition_that_nobody_wrote_is_damage(state: Path, sound: Path, change: str) -> None:
    """SQLite finds nothing wrong with these; the daemon would fail at every slot, or for ever."""
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.execute("PRAGMA writable_schema=ON")
        connection.execute(change)
        connection.commit()
    open_checked_store(state).close()
    assert len(databases_set_aside(state)) == 1
    assert wrong(rows_of(state / "dcam.db"), rows_of(sound / "dcam.db")) == 0


def test_a_database_of_an_older_version_is_salvaged_and_migrated(tmp_path: Path) -> None:
    """Its rows have no checksums: those that make sense are kept, and signed from now on."""
    engine = make_engine(tmp_path / "dcam.db")
    config = alembic_config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0002")
        for number in range(60):
            connection.exec_driver_sql(
                "INSERT INTO measurement (slot_utc, flag, reasons, x_mm, discs_found, corners_used,"
                " recorded_late, config_hash, version) VALUES (?, 1, '', ?, 5, 900, 0, 'c', ?)",
                (f"2026-03-01T00:{number:02}:00Z", number / 8, "0.1" * 50),
            )
        connection.exec_driver_sql(
            "INSERT INTO event VALUES (1, '2026-03-01T00:00:00.000000Z', 'started', '')"
        )
    engine.dispose()
    with (tmp_path / "dcam.db").open("r+b") as file:
        file.seek(100)
        file.write(bytes(500))
    open_checked_store(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as connection:
        found = connection.execute("SELECT slot_utc, x_mm, digest IS NULL FROM measurement")
        rows = [(f"2026-03-01T00:{number:02}:00Z", number / 8, 0) for number in range(60)]
        assert list(found) == rows
        assert connection.execute("SELECT kind FROM event").fetchall()[0] == ("started",)
