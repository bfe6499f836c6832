"""A checksum in every row: what was not written by the program is never given as a value."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from alembic import command
from sqlalchemy import update

from core.results import Measurement
from daemon.errors import DatabaseDamagedError
from daemon.store import migrate
from daemon.store.database import Store, open_store, open_store_readonly
from daemon.store.engine import make_engine
from daemon.store.integrity.checksum import row_digest
from daemon.store.integrity.digest import CheckedSession
from daemon.store.records import GapCause, Mark
from daemon.store.schema import Base, MeasurementRow
from tests.daemon.store.examples import (
    PERIOD_S,
    START,
    calibration,
    full_measurement,
    full_record,
    record,
    slot,
)


def fill(store: Store, old: Measurement | None = None) -> None:
    """Rows of every kind, also such as were changed after they were written.

    With old the full row is as an older version would have written it: this, and no readings.
    """
    store.add_calibration(calibration(), activate=True)
    store.record_gap(slot(0), slot(9), GapCause.CRASH, "fell", period_s=PERIOD_S)
    store.record_gap(slot(10), slot(12), GapCause.CRASH, period_s=PERIOD_S)
    row = full_record(slot(5), calibration_id=1)
    store.add_measurement(row if old is None else replace(row, measurement=old, readings=()))
    store.add_measurement(record(slot(30)))
    for time in ("2026-03-01T00:00:00.000000Z", "2026-03-01T00:01:00.000000Z"):
        store.set_mark(Mark.HEARTBEAT_UTC, time)
    store.add_event(START, "started", "Brücke, 3 °C")


def read_all(store: Store) -> list[object]:
    """Everything that a reader can ask for."""
    return [
        *store.measurements(),
        *store.gaps(),
        *store.calibrations(),
        store.active_calibration(),
        *store.events(),
        store.get_mark(Mark.HEARTBEAT_UTC),
    ]


def rows(path: Path) -> list[tuple[str, dict[str, object]]]:
    """Table and columns of each row, past the program."""
    found = []
    with closing(sqlite3.connect(path)) as connection:
        for table in Base.metadata.tables:
            cursor = connection.execute(f"SELECT * FROM {table}")
            names = [column[0] for column in cursor.description]
            found += [(table, dict(zip(names, row, strict=True))) for row in cursor]
    return found


def wrong(path: Path) -> list[tuple[str, dict[str, object]]]:
    """Rows whose digest does not fit them."""
    return [(table, row) for table, row in rows(path) if row_digest(table, row) != row["digest"]]


@pytest.fixture
def state(tmp_path: Path) -> Path:
    with open_store(tmp_path / "state") as store:
        fill(store)
    return tmp_path / "state"


def test_every_row_written_carries_its_digest(state: Path) -> None:
    tables = {table for table, _ in rows(state / "dcam.db")}
    assert tables == set(Base.metadata.tables) - {
        *("undated", "redated", "frame_day", "datum", "ledger")
    }
    assert wrong(state / "dcam.db") == []
    with open_store_readonly(state) as store:
        assert len(read_all(store)) == 2 + 2 + 1 + 1 + 1 + 1


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("UPDATE measurement SET x_mm = x_mm + 1e-9", "slot_utc 2026-03-01T00:05:00Z"),
        ("UPDATE measurement SET flag = 9 WHERE flag = 4", "slot_utc 2026-03-01T00:30:00Z"),
        ("UPDATE measurement SET reasons = 'moonlight'", "slot_utc 2026-03-01T00:05:00Z"),
        ("UPDATE measurement SET x_mm = 'x' WHERE x_mm > 0", "slot_utc 2026-03-01T00:05:00Z"),
        ("UPDATE measurement SET version = x'ff'", "2026-03-01T00:05:00Z"),
        ("UPDATE measurement SET version = CAST(x'ff' AS TEXT)", "slot_utc 2026-03-01T00:05:00Z"),
        ("UPDATE measurement SET digest = NULL", "slot_utc 2026-03-01T00:05:00Z"),
        (
            "UPDATE measurement SET slot_utc = '2026-13-01T00:05:00Z' WHERE id = 1",
            "slot_utc 2026-13-01",
        ),
        ("UPDATE gap SET cause = 'moonlight'", "a row of gap, start_utc"),
        ("UPDATE gap SET detail = 'stood' WHERE id = 2", "a row of gap"),
        ("UPDATE event SET id = 7", "a row of event"),
        ("UPDATE mark SET value = '2027' WHERE name = 'heartbeat_utc'", "name heartbeat_utc"),
        ("UPDATE calibration SET content = '{}'", "a row of calibration"),
    ],
)
def test_a_changed_row_is_an_error_and_no_value(state: Path, change: str, named: str) -> None:
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        connection.execute("DROP TRIGGER calibration_no_update")
        connection.execute(change)
        connection.commit()
    with (
        open_store_readonly(state) as store,
        pytest.raises(
            DatabaseDamagedError, match=r"dcam\.db: damaged \(.*: restart dcamd"
        ) as raised,
    ):
        read_all(store)
    assert named in str(raised.value)


def test_rows_of_an_older_version_are_signed_as_they_stand(tmp_path: Path) -> None:
    """The migration reckons digests as the program does, for rows of every kind."""
    state, full = tmp_path / "state", full_measurement()
    assert full.corrected is not None
    corrected = replace(full.corrected, image_mm2=None)
    with open_store(state) as store:
        fill(store, replace(full, corrected=corrected, closure=None, targets=()))
    with closing(sqlite3.connect(state / "dcam.db")) as new:
        tables = [table.name for table in Base.metadata.sorted_tables]
        copied = {table: new.execute(f"SELECT * FROM {table}") for table in tables}
        content = {
            table: (
                [column[0] for column in cursor.description],
                [row for row in cursor if row[0] != "schema"],
            )
            for table, cursor in copied.items()
        }
    old = tmp_path / "old"
    old.mkdir()
    engine = make_engine(old / "dcam.db")
    config = migrate.alembic_config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0003")
        for table, (names, found) in content.items():
            there = connection.exec_driver_sql(f"SELECT name FROM pragma_table_info('{table}')")
            known = [names.index(name) for (name,) in there]
            places = ", ".join("?" * len(known))
            for row in found:
                connection.exec_driver_sql(
                    f"INSERT INTO {table} ({', '.join(names[k] for k in known)}) VALUES ({places})",
                    tuple(row[k] for k in known),
                )
    engine.dispose()

    with open_store(old) as migrated, open_store_readonly(state) as store:
        assert list(map(repr, read_all(migrated))) == list(map(repr, read_all(store)))
    assert wrong(old / "dcam.db") == []


def test_rows_cannot_be_changed_past_their_digests(state: Path) -> None:
    engine = make_engine(state / "dcam.db")
    with CheckedSession(engine) as session, pytest.raises(TypeError, match="digests"):
        session.execute(update(MeasurementRow).values(version="0.2"))
    engine.dispose()
