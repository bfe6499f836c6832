"""Rows: one a slot, whole, in order, durable by every connection's own settings."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import fields, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from core.results import Flag
from daemon.errors import DatabaseBusyError, SlotTakenError, StoreError
from daemon.store import sqlite
from daemon.store.database import Store, open_store, open_store_readonly
from daemon.store.engine import make_engine
from daemon.store.queries import columns
from tests.daemon.store.examples import (
    BAD,
    FIXED,
    MEASURED,
    START,
    calibration,
    full_measurement,
    full_record,
    record,
    slot,
)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as opened:
        yield opened


def outside(directory: Path) -> closing[sqlite3.Connection]:
    """Another program's view of the database."""
    return closing(sqlite3.connect(directory / "dcam.db", isolation_level=None, timeout=0.0))


def same(one: object, other: object) -> bool:
    """Equality of nested records with arrays in them; sigmas are squares of square roots."""
    if isinstance(one, np.ndarray):
        return np.allclose(one, other, rtol=1e-15, atol=0.0)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    names = [field.name for field in fields(one)] if hasattr(one, "__dataclass_fields__") else []
    if names:
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    return one == other


def test_everything_in_a_row_comes_back(store: Store) -> None:
    identity = store.add_calibration(calibration())
    written = full_record(slot(0), identity)
    store.add_measurement(written)
    read = store.measurement(slot(0))
    assert read is not None
    assert same(written, read)


def test_a_bad_row_has_no_numbers(store: Store, tmp_path: Path) -> None:
    store.add_measurement(record(slot(0), BAD))
    with outside(tmp_path) as connection:
        row = connection.execute("SELECT slot_utc, flag, reasons, x_mm FROM measurement").fetchone()
    assert row == ("2026-03-01T00:00:00Z", 4, "main_target_not_found", None)


def test_a_slot_has_one_row(store: Store, tmp_path: Path) -> None:
    store.add_measurement(record(slot(0)))
    with pytest.raises(SlotTakenError, match="2026-03-01T00:00:00Z has a row already"):
        store.add_measurement(full_record(slot(0)))
    with outside(tmp_path) as connection:
        assert connection.execute("SELECT flag FROM measurement").fetchall() == [(4,)]
        with pytest.raises(sqlite3.IntegrityError, match="UNIQUE"):
            connection.execute(
                "INSERT INTO measurement (slot_utc, flag, reasons, discs_found, corners_used,"
                " recorded_late, config_hash, version)"
                " VALUES ('2026-03-01T00:00:00Z', 4, '', 0, 0, 0, '', '')"
            )


def test_a_slot_is_a_whole_second_in_a_zone(store: Store) -> None:
    for wrong in (slot(0).replace(tzinfo=None), slot(0) + timedelta(milliseconds=1)):
        with pytest.raises(ValueError, match="not a slot"):
            store.add_measurement(record(wrong))
    assert store.last_slot() is None


def test_a_good_row_must_have_a_value_and_a_bad_one_none(store: Store) -> None:
    for measurement in (
        replace(BAD, flag=Flag.GOOD),
        replace(full_measurement(), flag=Flag.BAD),
    ):
        with pytest.raises(StoreError, match="measurement_value"):
            store.add_measurement(record(slot(0), measurement))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_what_is_no_number_is_refused_and_not_made_null(store: Store, number: float) -> None:
    good = full_measurement()
    assert good.raw is not None
    wrong = replace(good.raw, mm=np.full(2, number))
    assert good.motion is not None
    for measurement in (
        replace(good, corrected=wrong),
        replace(good, closure=wrong),
        replace(good, targets=(FIXED, replace(MEASURED, raw=wrong))),
        replace(good, corrected=replace(good.raw, image_mm2=np.full((2, 2), number))),
        replace(good, corrected=replace(good.raw, covariance_mm2=np.full((2, 2), number))),
        replace(good, raw=wrong),
        replace(good, motion=replace(good.motion, rotation_rad=np.full(3, number))),
        replace(good, motion=replace(good.motion, covariance=np.full((6, 6), number))),
    ):
        with pytest.raises(StoreError, match="slot 2026-03-01T00:00:00Z cannot be stored"):
            store.add_measurement(record(slot(0), measurement))
    assert store.last_slot() is None


def test_a_row_names_a_calibration_that_exists(store: Store) -> None:
    with pytest.raises(StoreError, match="FOREIGN KEY"):
        store.add_measurement(full_record(slot(0), calibration_id=7))


def test_rows_come_in_the_order_of_slots_from_since_up_to_until(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(columns, "BATCH", 3)
    for number in (4, 0, 3, 1, 2, 6, 5):
        store.add_measurement(record(slot(number)))
    everything = [row.slot_utc for row in store.measurements()]
    assert everything == [slot(number) for number in range(7)]
    some = [row.slot_utc for row in store.measurements(slot(1), slot(5))]
    assert some == [slot(number) for number in range(1, 5)]
    assert store.measured_slots(slot(1), slot(5)) == set(some)
    between = START + timedelta(seconds=30, microseconds=5)
    assert next(store.measurements(between)).slot_utc == slot(1)
    assert store.last_slot() == slot(6)


def test_every_connection_syncs_every_commit(store: Store) -> None:
    with ExitStack() as stack:
        engine = make_engine(store.path)
        stack.callback(engine.dispose)
        for _ in range(4):
            connection = stack.enter_context(engine.connect())
            found = {
                name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
                for name in ("synchronous", "journal_mode", "foreign_keys", "busy_timeout")
            }
            assert found == {
                "synchronous": 2,
                "journal_mode": "wal",
                "foreign_keys": 1,
                "busy_timeout": 10_000,
            }


def test_a_place_that_cannot_hold_a_log_is_refused() -> None:
    with pytest.raises(StoreError, match="SQLite refuses journal_mode=WAL"):
        sqlite.connect(Path(":memory:"))


def test_a_reader_does_not_hold_up_the_writer(store: Store, tmp_path: Path) -> None:
    store.add_measurement(record(slot(0)))
    with outside(tmp_path) as reader:
        reader.execute("BEGIN")
        assert reader.execute("SELECT count(*) FROM measurement").fetchone() == (1,)
        store.add_measurement(record(slot(1)))
        assert reader.execute("SELECT count(*) FROM measurement").fetchone() == (1,)


def test_a_half_read_export_does_not_keep_the_log(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(columns, "BATCH", 1)
    for number in range(3):
        store.add_measurement(record(slot(number)))
    rows = store.measurements()
    next(rows)
    with outside(tmp_path) as other:
        other.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert store.path.with_name("dcam.db-wal").stat().st_size == 0
    assert next(rows).slot_utc == slot(1)


def test_the_writer_does_not_hold_up_a_reader(store: Store, tmp_path: Path) -> None:
    store.add_measurement(record(slot(0)))
    with outside(tmp_path) as writer, open_store_readonly(tmp_path) as reader:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE measurement SET version = 'half done'")
        assert [row.version for row in reader.measurements()] == ["0.1.0"]


def test_a_reader_cannot_write(store: Store, tmp_path: Path) -> None:
    with open_store_readonly(tmp_path) as reader, pytest.raises(StoreError, match="readonly"):
        reader.add_measurement(record(slot(0)))


def test_a_lock_that_stays_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite, "BUSY_TIMEOUT_S", 0.01)
    with open_store(tmp_path) as store, outside(tmp_path) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(DatabaseBusyError, match="another program holds it locked"):
            store.add_measurement(record(slot(0)))
        other.execute("COMMIT")
        store.add_measurement(record(slot(0)))


def known(store: Store, before: int) -> list[set[int]]:
    """The minutes of the rows that a row of a minute is held against, by each question for them."""
    past = store.past_rows(1, [SAID], 100, until=slot(before))
    hours = store.hourly_closures(1, START, slot(before))
    return [
        {round((time_s - START.timestamp()) / 60.0) for time_s in past.time_s},
        {minute_of(row.slot_utc) for row in store.rows_with_targets(slot(before), 1, 100)},
        {round((middle_s - START.timestamp()) / 60.0) - 30 for middle_s in hours[:, 0]},
    ]


SAID = "too_dark+main_target_partly_hidden"


def minute_of(slot_utc: datetime) -> int:
    return round((slot_utc - START) / timedelta(minutes=1))


def test_a_row_is_held_against_those_that_were_written_before_it(store: Store) -> None:
    """One that comes later to an earlier slot is none: a rebuild gives the row as it was."""
    store.add_calibration(calibration())
    plain = replace(full_record(slot(0), 1), redated_from_utc=None)
    hours = [replace(plain, slot_utc=START + timedelta(hours=hour)) for hour in range(3)]
    for written in (hours[0], hours[2], hours[1]):
        store.add_measurement(written)
    assert known(store, 180) == [{0, 60, 120}] * 3
    as_it_was = store.as_before(store.row_id(hours[1].slot_utc))
    assert known(as_it_was, 180) == [{0, 120}] * 3


def test_no_row_is_held_against_one_with_values_of_a_wrong_time(store: Store) -> None:
    """Until it was measured again; and what it was before stays."""
    store.add_calibration(calibration())
    plain = replace(full_record(slot(0), 1), redated_from_utc=None)
    for hour in range(3):
        store.add_measurement(replace(plain, slot_utc=START + timedelta(hours=hour)))
    moved = replace(plain, slot_utc=START + timedelta(hours=5), redated_from_utc=slot(60))
    state = store.state_before(slot(400))
    store.move_row(slot(60), moved)
    assert known(store, 400) == [{0, 120}] * 3
    assert store.state_before(slot(400)) != state
    state = store.state_before(slot(400))
    number, slot_utc = store.next_to_measure_again()
    assert slot_utc == moved.slot_utc
    store.measured_again(number, replace(moved, recorded_late=True))
    assert known(store, 400) == [{0, 120, 300}] * 3
    assert store.state_before(slot(400)) != state
    assert store.next_to_measure_again() is None
    (kept,) = store.redated()
    assert same(kept.before, replace(plain, slot_utc=slot(60)))


@pytest.mark.parametrize("change", ["DELETE FROM redated", "UPDATE redated SET content = '{}'"])
def test_what_a_wrong_clock_had_dated_cannot_be_changed(
    store: Store, tmp_path: Path, change: str
) -> None:
    store.add_measurement(record(slot(0)))
    store.move_row(slot(0), replace(record(slot(9)), redated_from_utc=slot(0)))
    with outside(tmp_path) as other, pytest.raises(sqlite3.IntegrityError, match="stays as it was"):
        other.execute(change)
