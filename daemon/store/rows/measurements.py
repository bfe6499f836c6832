"""The rows of slots: found by plain SQL, written through SQLAlchemy's session."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from daemon.errors import SlotTakenError, StoreError
from daemon.store.integrity.reading import fetch, value, whole_rows
from daemon.store.records import MeasurementRecord
from daemon.store.rows import gaps, redated
from daemon.store.rows.convert import measurement_columns, measurement_record, stored_time
from daemon.store.runs import next_second
from daemon.store.schema import MeasurementRow
from daemon.times import slot_text

_WITHIN = "slot_utc >= ? AND slot_utc < ?"


def add(session: Session, path: Path, record: MeasurementRecord) -> None:
    """Write one slot's row; a gap that holds the slot shrinks or splits around it.

    Raises SlotTakenError when the slot has a row already, StoreError for a measurement that is
    not finite.
    """
    try:
        row = MeasurementRow(**measurement_columns(record))
    except ValueError as error:
        msg = f"{path}: slot {slot_text(record.slot_utc)} cannot be stored: {error}"
        raise StoreError(msg) from error
    _take_slot(session, path, record.slot_utc)
    session.add(row)


def move(
    session: Session, path: Path, from_slot_utc: datetime, record: MeasurementRecord, unseen: int
) -> None:
    """Give a row that a wrong clock had dated its true slot; all else in it stays.

    It is kept as it was, and waits to be measured again (`rows.redated`). Raises SlotTakenError,
    and StoreError when no row is there.
    """
    row = _row(session, from_slot_utc)
    if row is None:
        msg = f"{path}: slot {slot_text(from_slot_utc)} has no row"
        raise StoreError(msg)
    redated.keep_row(session, row, record.slot_utc, unseen)
    _take_slot(session, path, record.slot_utc)
    row.slot_utc, row.captured_utc = record.slot_utc, record.captured_utc
    row.main_frame, row.sub_frame = record.main_frame, record.sub_frame
    row.redated_from_utc, row.recorded_late = record.redated_from_utc, False


def remove(session: Session, slot_utc: datetime, unseen: int) -> None:
    """Take a slot's row out; what it was is kept (`rows.redated`)."""
    row = _row(session, slot_utc)
    if row is not None:
        redated.keep_row(session, row, None, unseen)
        session.delete(row)


def replace(session: Session, record: MeasurementRecord) -> None:
    """Put a row in the place of that of its slot: it is the last one written."""
    columns = measurement_columns(record)
    newest_id = session.scalar(select(func.max(MeasurementRow.id))) or 0
    session.delete(_row(session, record.slot_utc))
    session.flush()  # or the new row would be written before the old one is gone
    session.add(MeasurementRow(id=newest_id + 1, **columns))


def _take_slot(session: Session, path: Path, slot_utc: datetime) -> None:
    if _row(session, slot_utc) is not None:
        msg = f"{path}: slot {slot_text(slot_utc)} has a row already"
        raise SlotTakenError(msg)
    gaps.release(session, slot_utc)


def _row(session: Session, slot_utc: datetime) -> MeasurementRow | None:
    query = select(MeasurementRow).where(MeasurementRow.slot_utc == slot_utc)
    return session.scalar(query)


# Reading


def find(connection: sqlite3.Connection, slot_utc: datetime) -> MeasurementRecord | None:
    """The row of a slot."""
    return _first(records(connection, "slot_utc = ?", slot_text(slot_utc)))


def unsynchronised(connection: sqlite3.Connection, boot_id: str) -> list[MeasurementRecord]:
    """The rows that a boot took while nothing disciplined the clock, in order."""
    return records(connection, "boot_id = ? AND clock_synchronised = 0 ORDER BY id", boot_id)


def slots(connection: sqlite3.Connection, since: datetime, until: datetime) -> set[datetime]:
    """The slots that have a row, since <= slot < until."""
    query = f"SELECT slot_utc FROM measurement WHERE {_WITHIN}"  # noqa: S608 - our own words
    return {stored_time(text) for (text,) in fetch(connection, query, *_limits(since, until))}


def reasons(
    connection: sqlite3.Connection, since: datetime, until: datetime
) -> dict[datetime, str]:
    """The slots with a row, since <= slot < until, in order, with their reasons as stored."""
    query = f"SELECT slot_utc, reasons FROM measurement WHERE {_WITHIN} ORDER BY slot_utc"  # noqa: S608
    found = fetch(connection, query, *_limits(since, until))
    return {stored_time(slot): words for slot, words in found}


def row_id(connection: sqlite3.Connection, slot_utc: datetime) -> int | None:
    """The id of a slot's row."""
    found = value(connection, "SELECT id FROM measurement WHERE slot_utc = ?", slot_text(slot_utc))
    return None if found is None else int(found)


def last_slot(connection: sqlite3.Connection) -> datetime | None:
    """The latest slot with a row."""
    found = value(connection, "SELECT max(slot_utc) FROM measurement")
    return None if found is None else stored_time(found)


def last_slot_but(connection: sqlite3.Connection, boot_id: str) -> datetime | None:
    """The latest slot with a row, but for what a boot took under an undisciplined clock."""
    query = (
        "SELECT slot_utc FROM measurement WHERE boot_id IS NOT ? OR clock_synchronised IS NOT 0"
        " ORDER BY slot_utc DESC LIMIT 1"
    )
    found = value(connection, query, boot_id)
    return None if found is None else stored_time(found)


def moved_from(connection: sqlite3.Connection, since: datetime) -> set[datetime]:
    """Slots, from `since` on, whose row went elsewhere: their frames belong to that."""
    query = (
        "SELECT redated_from_utc FROM measurement WHERE redated_from_utc >= ?1"
        " UNION SELECT from_slot_utc FROM redated WHERE from_slot_utc >= ?1"
    )
    found = fetch(connection, query, slot_text(next_second(since)))
    return {stored_time(text) for (text,) in found}


def _limits(since: datetime, until: datetime) -> tuple[str, str]:
    return slot_text(next_second(since)), slot_text(next_second(until))


def records(
    connection: sqlite3.Connection, where: str, *parameters: object
) -> list[MeasurementRecord]:
    """The rows that a condition holds of."""
    query = f"SELECT * FROM measurement WHERE {where}"  # noqa: S608 - our own words
    return [
        measurement_record(row) for row in whole_rows(connection, "measurement", query, *parameters)
    ]


def _first(records: Sequence[MeasurementRecord]) -> MeasurementRecord | None:
    return records[0] if records else None
