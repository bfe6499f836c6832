"""Calibrations never change and one of them is active; events and marks tell the history."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from daemon.store.database import Store, open_store
from daemon.store.records import EventRecord, Mark
from tests.daemon.store.examples import START, calibration, datum, slot


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as opened:
        yield opened


def test_a_calibration_comes_back_to_the_last_digit(store: Store) -> None:
    content = {"method": "rigid", "numbers": [0.1 + 0.2, 1e-300, -7, None, True], "deep": {"a": []}}
    written = calibration(content)
    identity = store.add_calibration(written)
    assert store.calibration(identity) == replace(written, id=identity)
    assert store.calibration(identity + 1) is None


def test_a_calibration_with_no_number_in_it_is_refused(store: Store) -> None:
    for content in ({"focal_px": float("nan")}, {"sigma": float("inf")}):
        with pytest.raises(ValueError, match="JSON compliant"):
            store.add_calibration(calibration(content))
    assert store.calibrations() == []


@pytest.mark.parametrize("table", ["calibration", "calibration_activation", "datum"])
def test_no_program_can_change_a_calibration(store: Store, table: str) -> None:
    store.add_calibration(calibration(), datum(1.0, 2.0), activate=True)
    with closing(sqlite3.connect(store.path)) as connection:
        columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        for column in columns:
            with pytest.raises(sqlite3.IntegrityError, match=f"{table} rows are immutable"):
                connection.execute(f"UPDATE {table} SET {column} = 9")
        with pytest.raises(sqlite3.IntegrityError, match=f"{table} rows are immutable"):
            connection.execute(f"DELETE FROM {table}")


def test_the_calibration_activated_last_is_active(store: Store) -> None:
    first = store.add_calibration(calibration(), activate=True)
    second = store.add_calibration(calibration())
    active = store.active_calibration()
    assert active is not None
    assert active.id == first
    third = store.add_calibration(calibration(), activate=True)
    active = store.active_calibration()
    assert active is not None
    assert active.id == third
    assert [one.id for one in store.calibrations()] == [first, second, third]


def test_events_are_read_by_time_and_kind(store: Store) -> None:
    events = [
        EventRecord(START + timedelta(seconds=0.25), "started", "dcamd 0.1.0"),
        EventRecord(START + timedelta(seconds=0.5), "camera_lost", "sub"),
        EventRecord(slot(1), "camera_back", "sub"),
    ]
    for event in reversed(events):
        store.add_event(event.time_utc, event.kind, event.detail)
    assert store.events() == events
    assert store.events(events[1].time_utc, slot(1)) == events[1:2]
    assert store.events(kind="camera_back") == events[2:]


def test_a_mark_is_kept_replaced_and_removed(tmp_path: Path) -> None:
    with open_store(tmp_path) as store:
        store.set_mark(Mark.BOOT_ID, "one")
        store.set_mark(Mark.BOOT_ID, "two")
    with open_store(tmp_path) as store:
        assert store.get_mark(Mark.BOOT_ID) == "two"
        assert store.get_mark(Mark.CLEAN_STOP_UTC) is None
        store.set_mark(Mark.BOOT_ID, None)
        store.set_mark(Mark.BOOT_ID, None)
        assert store.get_mark(Mark.BOOT_ID) is None
