"""One axis of one target over a while, in the record's zero: plain SQL, as cheap as a status.

An alarm looks every minute; nothing here loads SQLAlchemy or reads a column that it does not need.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from core.results import Flag, Reason
from core.site import MAIN
from daemon.store.integrity.reading import fetch
from daemon.store.ledger.entries import excluded_spans, ledger_entries, span_numbers
from daemon.store.records import BELIEVED, DatumMethod
from daemon.store.rows.datum import Datums, common, needs_gains, read_datums, sum_sigma_mm
from daemon.store.rows.targets import gains_in
from daemon.store.runs import next_second
from daemon.store.sqlite import connect_readonly, existing_path, said_plainly
from daemon.times import slot_text

TRUSTED = (*BELIEVED, Reason.CAMERA_BUMPED.value)
"""Reasons of rows whose value may raise an alarm: what moves faster than the bridge can, may be it.

All other suspect rows have a value that something else explains.
"""


@dataclass(frozen=True, slots=True)
class PointRow:
    """A row's value of one axis of one target."""

    time_s: float
    """The slot, since 1970."""
    value: float
    """mm."""
    sigma: float
    """mm."""
    is_good: bool


@dataclass(frozen=True, slots=True)
class PointRows:
    """The rows of a while that are believed, in order, and how many are not."""

    rows: tuple[PointRow, ...]
    left_out: int
    """With a value that is suspect."""


@contextmanager
def open_points(state: Path) -> Iterator[sqlite3.Connection]:
    """Open the database of a state directory for `point_rows`. Raises StoreError."""
    path = existing_path(state)
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.execute("BEGIN").close()
        yield connection


def point_rows(
    connection: sqlite3.Connection, target: str, axis: str, since_utc: datetime, until_utc: datetime
) -> PointRows:
    """Rows with a value, since <= slot < until; `target` is `main` or a further target's name.

    Those that the quality ledger excludes are left out, and are not passed over as untrusted.
    """
    limits = [slot_text(next_second(time)) for time in (since_utc, until_utc)]
    if target == MAIN:
        query = (
            "SELECT CAST(strftime('%s', slot_utc) AS INTEGER), calibration_id, flag, reasons,"  # noqa: S608 - our own names
            f" {axis}_mm, sigma_{axis}_mm, targets FROM measurement"
            f" WHERE slot_utc >= ? AND slot_utc < ? AND {axis}_mm IS NOT NULL ORDER BY slot_utc"
        )
        found = fetch(connection, query, *limits)
    else:
        query = (
            "SELECT CAST(strftime('%s', slot_utc) AS INTEGER), calibration_id,"  # noqa: S608
            " json_extract(one.value, '$.flag'), json_extract(one.value, '$.reasons'),"
            f" json_extract(one.value, '$.{axis}_mm'), json_extract(one.value, '$.sigma_{axis}_mm')"
            ", targets FROM measurement,"
            " json_each(CASE WHEN json_valid(targets) THEN targets ELSE '[]' END) AS one"
            " WHERE slot_utc >= ? AND slot_utc < ? AND json_extract(one.value, '$.name') = ?"
            f" AND json_extract(one.value, '$.{axis}_mm') IS NOT NULL ORDER BY slot_utc"
        )
        found = fetch(connection, query, *limits, target)
    spans = excluded_spans(ledger_entries(connection), target)
    slots = np.array([row[0] for row in found], dtype="datetime64[s]")
    found = [row for row, out in zip(found, span_numbers(slots, spans), strict=True) if out < 0]
    datums = read_datums(connection)
    trusted = [row for row in found if row[3] in TRUSTED]
    rows = tuple(_row(row, datums, target, axis) for row in trusted)
    return PointRows(rows, len(found) - len(rows))


def reading_rows(
    connection: sqlite3.Connection, reading: str, since_utc: datetime, until_utc: datetime
) -> PointRows:
    """What a sensor said, or a camera of its temperature (`temperature-main`); sigmas are 0."""
    column = {
        "temperature-main": "main_temperature_c",
        "temperature-sub": "sub_temperature_c",
    }.get(reading)
    limits = [slot_text(next_second(time)) for time in (since_utc, until_utc)]
    if column is not None:
        query = (
            f"SELECT CAST(strftime('%s', slot_utc) AS INTEGER), {column} FROM measurement"  # noqa: S608
            f" WHERE slot_utc >= ? AND slot_utc < ? AND {column} IS NOT NULL ORDER BY slot_utc"
        )
        found = fetch(connection, query, *limits)
    else:
        query = (
            "SELECT CAST(strftime('%s', slot_utc) AS INTEGER), json_extract(one.value, '$[0]')"
            " FROM measurement, json_each(readings) AS one"
            " WHERE slot_utc >= ? AND slot_utc < ? AND json_valid(readings) AND one.key = ?"
            " AND json_extract(one.value, '$[0]') IS NOT NULL ORDER BY slot_utc"
        )
        found = fetch(connection, query, *limits, reading)
    return PointRows(tuple(PointRow(float(t), float(v), 0.0, is_good=True) for t, v in found), 0)


def _row(
    row: tuple[int, int, int, str, float, float, str | None],
    datums: Datums,
    target: str,
    axis: str,
) -> PointRow:
    time_s, calibration, flag, _, value, sigma, seen = row
    index = "xy".index(axis)
    link = datums.get(calibration)
    offset = None
    if link is not None and link.method is not DatumMethod.ORIGIN:
        offset = link.offset if target == MAIN else link.targets.get(target)
    if link is not None and offset is not None:
        gains = gains_in(seen, target) if needs_gains(link) else {}
        common_mm2 = common(link, target, gains)[index, index]
        value += float(offset.mm[index])
        sigma = sum_sigma_mm(sigma, offset.covariance_mm2[index, index], common_mm2)
    return PointRow(float(time_s), float(value), float(sigma), flag == Flag.GOOD)
