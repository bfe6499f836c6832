"""What the page asks of a record: one slot, its neighbours, runs of flags, events, calibrations.

Plain SQL over a connection whose owner begins and ends the transaction.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from core.results import Measurement
from daemon.store.integrity.reading import fetch, value, whole_rows
from daemon.store.records import GapCause, GapRecord
from daemon.store.rows.convert import measurement_record, stored_time
from daemon.store.rows.datum import datum_of, in_record_zero
from daemon.times import instant_text, slot_text

MOST_ROWS = 5000
"""Of a list: what more there is, is not shown."""


@dataclass(frozen=True, slots=True)
class SlotView:
    """One slot's row."""

    slot_utc: datetime
    measurement: Measurement
    """In the record's zero."""
    columns: Mapping[str, Any]
    """Everything else, as the table holds it."""


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """A calibration without its content, which is large."""

    id: int
    created_utc: datetime
    method: str
    passed: bool
    is_active: bool
    lines: tuple[str, ...]
    figures: Mapping[str, Any]


def slot_view(connection: sqlite3.Connection, slot_utc: datetime) -> SlotView | None:
    """The row of a slot. Raises DamagedRowError."""
    query = "SELECT * FROM measurement WHERE slot_utc = ?"
    found = whole_rows(connection, "measurement", query, slot_text(slot_utc))
    if not found:
        return None
    record = measurement_record(found[0])
    datum = datum_of(connection, record.calibration_id)
    return SlotView(slot_utc, in_record_zero(record.measurement, datum), found[0])


def neighbours(
    connection: sqlite3.Connection, slot_utc: datetime
) -> tuple[datetime | None, datetime | None]:
    """The slots with a row before and after one."""
    before = "SELECT max(slot_utc) FROM measurement WHERE slot_utc < ?"
    after = "SELECT min(slot_utc) FROM measurement WHERE slot_utc > ?"
    found = (value(connection, query, slot_text(slot_utc)) for query in (before, after))
    previous, following = (None if text is None else stored_time(text) for text in found)
    return previous, following


def frame_name(connection: sqlite3.Connection, slot_utc: datetime, role: str) -> str | None:
    """The frame that a slot's row names, relative to the state directory."""
    column = {"main": "main_frame", "sub": "sub_frame"}[role]
    query = f"SELECT {column} FROM measurement WHERE slot_utc = ?"  # noqa: S608 - one of two words
    found = value(connection, query, slot_text(slot_utc))
    return None if found is None else str(found)


def last_slot_with_frames(connection: sqlite3.Connection) -> datetime | None:
    """The newest slot that kept its frames, among the last rows."""
    query = (
        "SELECT max(slot_utc) FROM (SELECT slot_utc, main_frame, sub_frame FROM measurement"
        " ORDER BY slot_utc DESC LIMIT 5000) WHERE main_frame IS NOT NULL AND sub_frame IS NOT NULL"
    )
    found = value(connection, query)
    return None if found is None else stored_time(found)


def flagged_rows(
    connection: sqlite3.Connection, since: str, until: str
) -> list[tuple[int, int, str]]:
    """Slots (s since 1970) with since <= slot < until, with flag and reasons, in order."""
    query = (
        "SELECT CAST(strftime('%s', slot_utc) AS INTEGER), flag, reasons FROM measurement"
        " WHERE slot_utc >= ? AND slot_utc < ? ORDER BY slot_utc"
    )
    return fetch(connection, query, since, until)


def gaps_within(
    connection: sqlite3.Connection, since: str, until: str, least_s: float = 0.0
) -> list[GapRecord]:
    """Gaps that touch a span and are not shorter than some seconds; the newest `MOST_ROWS`."""
    query = (
        "SELECT * FROM gap WHERE end_utc >= ? AND start_utc < ? AND slots * period_s >= ?"
        " ORDER BY start_utc DESC LIMIT ?"
    )
    rows = whole_rows(connection, "gap", query, since, until, least_s, MOST_ROWS)
    return [
        GapRecord(
            stored_time(row["start_utc"]),
            stored_time(row["end_utc"]),
            row["period_s"],
            GapCause(row["cause"]),
            row["detail"],
        )
        for row in reversed(rows)
    ]


def events_within(
    connection: sqlite3.Connection, since: datetime, until: datetime, most: int = MOST_ROWS
) -> list[tuple[str, str, str]]:
    """Time, kind and detail of the newest events of a span, newest first."""
    query = (
        "SELECT time_utc, kind, detail FROM event WHERE time_utc >= ? AND time_utc < ?"
        " ORDER BY time_utc DESC, id DESC LIMIT ?"
    )
    return fetch(connection, query, instant_text(since), instant_text(until), most)


def calibration_views(connection: sqlite3.Connection) -> list[CalibrationView]:
    """All calibrations, oldest first."""
    newest = "SELECT calibration_id FROM calibration_activation ORDER BY id DESC LIMIT 1"
    active = value(connection, newest)
    query = "SELECT id, created_utc, method, passed, report FROM calibration ORDER BY id"
    found = []
    for number, created, method, passed, report in fetch(connection, query):
        said = json.loads(report)
        found.append(
            CalibrationView(
                number,
                stored_time(created),
                method,
                bool(passed),
                number == active,
                tuple(said.get("lines", ())),
                said.get("figures", {}),
            )
        )
    return found


def readings_named(connection: sqlite3.Connection) -> dict[str, str]:
    """The readings of the newest row with any, and their units."""
    query = (
        "SELECT readings FROM (SELECT readings FROM measurement ORDER BY slot_utc DESC LIMIT 500)"
        " WHERE readings IS NOT NULL LIMIT 1"
    )
    text = value(connection, query)
    return {name: said[1] for name, said in json.loads(text).items()} if text else {}
