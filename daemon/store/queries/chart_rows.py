"""Rows as charts need them: numbers by quantity, in the record's zero, with flags and a checksum.

Plain SQL over a connection whose owner begins and ends the transaction. Rows are not proved one by
one as in `read_columns`: the page shows what is there, and `verify` says what is damaged.
"""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from core.arrays import FloatArray
from core.results import Reason
from core.site import MAIN
from daemon.store.integrity.reading import fetch, value
from daemon.store.records import DatumMethod, DatumRecord
from daemon.store.rows.datum import Datums, common, needs_gains
from daemon.store.rows.targets import gains_in

POINT_KEYS = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "raw_x_mm", "raw_y_mm")
"""Of the main target and of each further one."""
ROW_KEYS = (
    *("closure_x_mm", "closure_y_mm", "closure_sigma_x_mm", "closure_sigma_y_mm"),
    *("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"),
)
_TEMPERATURES = {
    "temperature_main_c": "main_temperature_c",
    "temperature_sub_c": "sub_temperature_c",
}
_TIME = "CAST(strftime('%s', slot_utc) AS INTEGER)"
_ALWAYS = (_TIME, "flag", "reasons", "calibration_id")
_READ = (
    *(*_ALWAYS, "digest"),
    *("targets", "readings", *POINT_KEYS, *ROW_KEYS, *_TEMPERATURES.values()),
)
_PART = 0xFFFF_FFFF
"""Of a digest: so that the sum of many fits into 64 bits."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_BITS = {reason.value: 1 << place for place, reason in enumerate(Reason)}
_OTHER_BIT = 1 << 55
"""A reason of another version."""
_FLAG_BITS = {3: 1 << 56, 4: 1 << 57, 9: 1 << 58}

Times = npt.NDArray[np.int64]
Masks = npt.NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class ChartRows:
    """Consecutive rows."""

    time_s: Times
    """(n,) slots, since 1970."""
    flags: npt.NDArray[np.uint8]
    """(n,)"""
    masks: Masks
    """(n,) flag and reasons of a row as bits, 0 of a good one: see `said_by`."""
    values: Mapping[str, FloatArray]
    """(n,) by quantity: `x_mm.main`, `closure_x_mm`, `reading_air`; NaN where there is none."""
    digest: int
    """Changes with any of the rows; 0 where only some quantities were wanted."""


def chart_rows(
    connection: sqlite3.Connection,
    since: str,
    until: str,
    datums: Datums,
    wanted: Collection[str] | None = None,
) -> ChartRows:
    """Rows with since <= slot < until, both as the table holds slots, in order.

    Only the wanted quantities, if any are named: to read the others takes time.
    """
    read = _READ if wanted is None else _needed(wanted, datums)
    query = (
        f"SELECT {', '.join(read)} FROM measurement"  # noqa: S608 - our own words
        " WHERE slot_utc >= ? AND slot_utc < ? ORDER BY slot_utc"
    )
    rows = fetch(connection, query, since, until)
    columns = dict(zip(read, zip(*rows, strict=True), strict=True)) if rows else {}
    if not rows:
        nothing = np.zeros(0, np.int64)
        return ChartRows(nothing, nothing.astype(np.uint8), nothing.astype(np.uint64), {}, 0)
    values = _row_values(columns)
    values |= _target_values(columns.get("targets", ()))
    values |= _reading_values(columns.get("readings", ()))
    calibrations = np.array(columns["calibration_id"], dtype=np.float64)
    _move(values, calibrations, columns.get("targets", ()), datums)
    flags = np.array(columns["flag"], np.uint8)
    return ChartRows(
        np.array(columns[_TIME], np.int64),
        flags,
        _masks(columns["flag"], columns["reasons"]),
        values,
        sum((digest or 0) & _PART for digest in columns.get("digest", ())),
    )


def _row_values(columns: Mapping[str, Sequence[Any]]) -> dict[str, FloatArray]:
    names = {f"{key}.{MAIN}": key for key in POINT_KEYS} | {key: key for key in ROW_KEYS}
    return {
        name: np.array(columns[column], dtype=np.float64)
        for name, column in {**names, **_TEMPERATURES}.items()
        if column in columns
    }


def _needed(wanted: Collection[str], datums: Datums) -> tuple[str, ...]:
    """The columns that some quantities are made of, in the record's zero."""
    keys = {_TEMPERATURES.get(name, name.removesuffix(f".{MAIN}")) for name in wanted}
    has_sigma = not keys.isdisjoint({"sigma_x_mm", "sigma_y_mm"})
    if any("." in key for key in keys) or (has_sigma and any(map(needs_gains, datums.values()))):
        keys.add("targets")
    if any(key.startswith("reading_") for key in keys):
        keys.add("readings")
    return (*_ALWAYS, *(column for column in _READ if column in keys))


def _target_values(texts: Sequence[str | None]) -> dict[str, FloatArray]:
    found: dict[str, FloatArray] = {}
    for row, text in enumerate(texts):
        for seen in _parsed(text, list) or ():
            name = seen.get("name") if isinstance(seen, dict) else None
            if not isinstance(name, str) or not _NAME.fullmatch(name):
                continue
            for key in POINT_KEYS:
                if isinstance(number := seen.get(key), int | float):
                    _column(found, f"{key}.{name}", len(texts))[row] = number
    return found


def _reading_values(texts: Sequence[str | None]) -> dict[str, FloatArray]:
    found: dict[str, FloatArray] = {}
    for row, text in enumerate(texts):
        for name, said in (_parsed(text, dict) or {}).items():
            if _NAME.fullmatch(name) and said and isinstance(said[0], int | float):
                _column(found, f"reading_{name}", len(texts))[row] = said[0]
    return found


def _column(found: dict[str, FloatArray], name: str, rows: int) -> FloatArray:
    if name not in found:
        found[name] = np.full(rows, np.nan)
    return found[name]


def _parsed(text: str | None, kind: type) -> Any:
    """JSON of the table; None of a column that is empty or damaged."""
    if text is None:
        return None
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, kind) else None


def _move(
    values: dict[str, FloatArray],
    calibrations: FloatArray,
    texts: Sequence[str | None],
    datums: Datums,
) -> None:
    """Add the datum of each row's calibration, and its variance."""
    for number, link in datums.items():
        if link.method is DatumMethod.ORIGIN or not (of_it := calibrations == number).any():
            continue
        for name, offset in {MAIN: link.offset, **link.targets}.items():
            for axis, letter in enumerate("xy"):
                for prefix in ("", "raw_"):
                    if (column := values.get(f"{prefix}{letter}_mm.{name}")) is not None:
                        column[of_it] += offset.mm[axis]
            sigmas = [values.get(f"sigma_{letter}_mm.{name}") for letter in "xy"]
            if any(column is not None for column in sigmas):
                common_mm2 = _common(link, name, texts, of_it)
                for axis, column in enumerate(sigmas):
                    if column is not None:
                        datum_mm2 = offset.covariance_mm2[axis, axis]
                        least = (column[of_it] - np.sqrt(datum_mm2)) ** 2
                        whole = column[of_it] ** 2 + datum_mm2 + common_mm2[:, axis]
                        column[of_it] = np.sqrt(np.maximum(whole, least))


def _common(
    link: DatumRecord, target: str, texts: Sequence[str | None], of_it: npt.NDArray[np.bool_]
) -> FloatArray:
    """(rows, 2) mm^2 that x and y of the rows of a calibration have in common with its datum."""
    if not needs_gains(link):
        return np.tile(np.diag(common(link, target, {})), (int(of_it.sum()), 1))
    seen = (text for text, own in zip(texts, of_it, strict=True) if own)
    return np.array([np.diag(common(link, target, gains_in(text, target))) for text in seen])


def _masks(flags: Sequence[int], reasons: Sequence[str]) -> Masks:
    known: dict[tuple[int, str], int] = {}
    masks = np.zeros(len(flags), np.uint64)
    for row, said in enumerate(zip(flags, reasons, strict=True)):
        if said == (1, ""):
            continue
        if said not in known:
            words = (_BITS.get(word, _OTHER_BIT) for word in said[1].split("+") if word)
            known[said] = _FLAG_BITS.get(said[0], 0)
            for word in words:
                known[said] |= word
        masks[row] = known[said]
    return masks


def said_by(mask: int) -> tuple[int, list[str]]:
    """The worst flag and the reasons of rows whose masks were joined."""
    flag = max((flag for flag, bit in _FLAG_BITS.items() if mask & bit), default=1)
    reasons = [word for word, bit in _BITS.items() if mask & bit]
    return flag, [*reasons, *(["other"] if mask & _OTHER_BIT else [])]


def row_count(connection: sqlite3.Connection, since: str, until: str, most: int) -> int:
    """How many rows there are with since <= slot < until, counted up to `most`."""
    query = (
        "SELECT count(*) FROM (SELECT 1 FROM measurement"
        " WHERE slot_utc >= ? AND slot_utc < ? LIMIT ?)"
    )
    return int(value(connection, query, since, until, most))


def days_with_rows(connection: sqlite3.Connection, before: str) -> Iterator[str]:
    """Days (`2026-03-01`) with rows before a slot, newest first: one step of the index each."""
    query = "SELECT max(slot_utc) FROM measurement WHERE slot_utc < ?"
    while last := value(connection, query, before):
        yield (before := last[:10])


def span_of_calibration(connection: sqlite3.Connection, number: int) -> tuple[str, str] | None:
    """The first and the last slot of a calibration's rows."""
    query = "SELECT min(slot_utc), max(slot_utc) FROM measurement WHERE calibration_id = ?"
    first, last = fetch(connection, query, number)[0]
    return None if first is None else (first, last)


def moved_rows(connection: sqlite3.Connection) -> str:
    """Changes when a row was moved to another slot, or became undated."""
    query = (
        f"SELECT count(*), coalesce(sum(digest & {_PART}), 0), (SELECT count(*) FROM undated)"  # noqa: S608 - a number
        " FROM measurement WHERE redated_from_utc IS NOT NULL"
    )
    return " ".join(map(str, fetch(connection, query)[0]))


def day_digest(connection: sqlite3.Connection, since: str, until: str) -> tuple[int, int]:
    """How many rows a day has, and their digest as `ChartRows` has it."""
    query = (
        f"SELECT count(*), coalesce(sum(digest & {_PART}), 0) FROM measurement"  # noqa: S608 - a number
        " WHERE slot_utc >= ? AND slot_utc < ?"
    )
    rows, digest = fetch(connection, query, since, until)[0]
    return rows, digest
