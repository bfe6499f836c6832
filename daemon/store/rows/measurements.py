"""The rows of slots: found by plain SQL, written through SQLAlchemy's session."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from daemon.errors import DamagedRowError, SlotTakenError, StoreError
from daemon.store.integrity.reading import fetch, value, whole_rows
from daemon.store.records import MeasurementRecord, PastRows
from daemon.store.rows import gaps
from daemon.store.rows.convert import measurement_columns, measurement_record, stored_time
from daemon.store.runs import next_second
from daemon.store.schema import MeasurementRow
from daemon.times import slot_text

_PAST = (
    *("x_mm", "y_mm", "raw_x_mm", "raw_y_mm", "tx_mm", "ty_mm", "tz_mm"),
    *("coalesce(sigma_image_x_mm, sigma_x_mm)", "coalesce(sigma_image_y_mm, sigma_y_mm)"),
    *("closure_x_mm", "closure_y_mm", "sub_residual_px", "sub_contrast_dn"),
)
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


def move(session: Session, path: Path, from_slot_utc: datetime, record: MeasurementRecord) -> None:
    """Give a row that a wrong clock had dated its true slot; all else in it stays.

    Raises SlotTakenError, and StoreError when no row is there.
    """
    row = _row(session, from_slot_utc)
    if row is None:
        msg = f"{path}: slot {slot_text(from_slot_utc)} has no row"
        raise StoreError(msg)
    _take_slot(session, path, record.slot_utc)
    row.slot_utc, row.captured_utc = record.slot_utc, record.captured_utc
    row.main_frame, row.sub_frame = record.main_frame, record.sub_frame
    row.redated_from_utc = record.redated_from_utc


def remove(session: Session, slot_utc: datetime) -> None:
    """Take a slot's row out."""
    session.delete(_row(session, slot_utc))


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
    return _first(_records(connection, "slot_utc = ?", slot_text(slot_utc)))


def past(
    connection: sqlite3.Connection,
    calibration_id: int,
    reasons: Sequence[str],
    since: datetime,
    until: datetime,
    limit: int,
    *,
    newest: bool = True,
) -> PastRows:
    """The last (or first) rows with a value and since <= slot < until, by one calibration.

    Only those whose reasons, as the table holds them, are among the given. Raises DamagedRowError.
    """
    query = (
        f"SELECT CAST(strftime('%s', slot_utc) AS INTEGER), {', '.join(_PAST)} FROM measurement"  # noqa: S608 - our own words
        " WHERE calibration_id = ? AND reasons = ? AND slot_utc >= ? AND slot_utc < ?"
        f" AND x_mm IS NOT NULL ORDER BY slot_utc {'DESC' if newest else 'ASC'} LIMIT ?"
    )
    begin, end = _limits(since, until)
    # One after the other, so that the index gives the last ones of each without a search.
    found = [
        row
        for word in reasons
        for row in fetch(connection, query, calibration_id, word, begin, end, limit)
    ]
    found = sorted(found)[-limit:] if newest else sorted(found)[:limit]
    try:
        table = np.array(found, dtype=np.float64).reshape(len(found), 1 + len(_PAST))
    except (TypeError, ValueError) as error:
        msg = f"a number of a row is none: {error}"
        raise DamagedRowError(msg) from error
    columns = np.split(table, np.cumsum([1, 2, 2, 3, 2, 2, 1]), axis=1)
    time_s, mm, raw_mm, translation_mm, sigma_mm, closure_mm, residual_px, contrast_dn = columns
    return PastRows(
        time_s[:, 0],
        mm,
        raw_mm,
        translation_mm,
        sigma_mm,
        closure_mm,
        residual_px[:, 0],
        contrast_dn[:, 0],
    )


def last_with_targets(
    connection: sqlite3.Connection, slot_utc: datetime, calibration_id: int, limit: int
) -> list[MeasurementRecord]:
    """The last rows before a slot, by one calibration, that say something of further targets."""
    where = (
        "calibration_id = ? AND slot_utc < ? AND targets IS NOT NULL ORDER BY slot_utc DESC LIMIT ?"
    )
    before = slot_text(next_second(slot_utc))
    return _records(connection, where, calibration_id, before, limit)[::-1]


def unsynchronised(connection: sqlite3.Connection, boot_id: str) -> list[MeasurementRecord]:
    """The rows that a boot took while nothing disciplined the clock, in order."""
    return _records(connection, "boot_id = ? AND clock_synchronised = 0 ORDER BY id", boot_id)


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
    """Slots, from `since` on, whose row was moved to another: their frames belong to that."""
    query = "SELECT redated_from_utc FROM measurement WHERE redated_from_utc >= ?"
    found = fetch(connection, query, slot_text(next_second(since)))
    return {stored_time(text) for (text,) in found}


def _limits(since: datetime, until: datetime) -> tuple[str, str]:
    return slot_text(next_second(since)), slot_text(next_second(until))


def _records(
    connection: sqlite3.Connection, where: str, *parameters: object
) -> list[MeasurementRecord]:
    query = f"SELECT * FROM measurement WHERE {where}"  # noqa: S608 - our own words
    return [
        measurement_record(row) for row in whole_rows(connection, "measurement", query, *parameters)
    ]


def _first(records: Sequence[MeasurementRecord]) -> MeasurementRecord | None:
    return records[0] if records else None
