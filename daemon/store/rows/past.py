"""The rows that a new one is held against: of those before its slot the known ones."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from datetime import datetime

import numpy as np

from daemon.errors import DamagedRowError
from daemon.store.integrity.reading import fetch, value
from daemon.store.records import MeasurementRecord, PastRows
from daemon.store.rows import measurements
from daemon.store.rows.known import KNOWN
from daemon.store.runs import next_second
from daemon.times import slot_text

_PAST = (
    *("x_mm", "y_mm", "raw_x_mm", "raw_y_mm", "tx_mm", "ty_mm", "tz_mm"),
    *("coalesce(sigma_image_x_mm, sigma_x_mm)", "coalesce(sigma_image_y_mm, sigma_y_mm)"),
    *("closure_x_mm", "closure_y_mm", "sub_residual_px", "sub_contrast_dn"),
)


def past(
    connection: sqlite3.Connection,
    calibration_id: int,
    reasons: Sequence[str],
    since: datetime,
    until: datetime,
    limit: int,
    *,
    before_id: int,
    newest: bool = True,
) -> PastRows:
    """The last (or first) rows with a value and since <= slot < until, by one calibration.

    Only those whose reasons, as the table holds them, are among the given. Raises DamagedRowError.
    """
    query = (
        f"SELECT CAST(strftime('%s', slot_utc) AS INTEGER), {', '.join(_PAST)} FROM measurement"  # noqa: S608 - our own words
        " WHERE calibration_id = ? AND reasons = ? AND slot_utc >= ? AND slot_utc < ?"
        f" AND x_mm IS NOT NULL AND {KNOWN} ORDER BY slot_utc {'DESC' if newest else 'ASC'} LIMIT ?"
    )
    begin, end = (slot_text(next_second(time)) for time in (since, until))
    # One after the other, so that the index gives the last ones of each without a search.
    found = [
        row
        for word in reasons
        for row in fetch(connection, query, calibration_id, word, begin, end, before_id, limit)
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
    connection: sqlite3.Connection,
    slot_utc: datetime,
    calibration_id: int,
    limit: int,
    before_id: int,
) -> list[MeasurementRecord]:
    """The last rows before a slot, by one calibration, that say something of further targets."""
    where = (
        "calibration_id = ? AND slot_utc < ? AND targets IS NOT NULL"
        f" AND {KNOWN} ORDER BY slot_utc DESC LIMIT ?"
    )
    before = slot_text(next_second(slot_utc))
    return measurements.records(connection, where, calibration_id, before, before_id, limit)[::-1]


def state_before(
    connection: sqlite3.Connection, until: datetime, before_id: int
) -> tuple[int, int]:
    """Changes when another row before a slot is known, or one was dated again."""
    # The sign keeps SQLite from looking through all slots: the last rows written are few.
    query = "SELECT id FROM measurement WHERE id < ? AND +slot_utc < ? ORDER BY id DESC LIMIT 1"
    newest_id = value(connection, query, before_id, slot_text(next_second(until)))
    redated = value(connection, "SELECT max(id) FROM redated")
    return int(newest_id or 0), int(redated or 0)
