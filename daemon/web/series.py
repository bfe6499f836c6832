"""What `/api/series` and `/api/spans` give: the record over a span in as many pieces as fit.

Few rows are given one by one, more of them in buckets worked out from the rows, and what would be
too many to read from the pyramid: its buckets hold every row, so that no peak is lost.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt

from daemon.store.integrity.reading import value
from daemon.store.ledger.entries import LedgerEntry, in_force, ledger_entries
from daemon.store.queries.chart_rows import ChartRows, Masks, chart_rows, row_count, said_by
from daemon.store.queries.record_view import events_within, flagged_rows, gaps_within
from daemon.store.rows.datum import read_datums
from daemon.store.runs import next_second
from daemon.times import slot_text
from daemon.web.asking import AskedWronglyError, seconds
from daemon.web.exclusion import BucketsWithout, Excluded, excluded_of, rows_without
from daemon.web.pyramid import (
    BUCKET,
    EPOCH_S,
    LEVELS,
    ROWS_A_BUCKET,
    Buckets,
    Pyramid,
    bucketed,
    merged,
)
from daemon.web.record import Record

MOST_BUCKETS = 8000
MOST_QUANTITIES = 64
QUANTITY = re.compile(r"[A-Za-z0-9_]{1,32}(\.[A-Za-z0-9][A-Za-z0-9_-]{0,63})?|reading_[\w-]{1,64}")
_CAUSE_SHARE = 4
"""Gaps shorter than this part of the resolution are not listed one by one."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A span, what of it, and in how many pieces."""

    quantities: tuple[str, ...]
    since: datetime
    until: datetime
    buckets: int
    without_excluded: bool = False
    """Leave out what the quality ledger excludes."""

    @property
    def width_s(self) -> float:
        """Of a piece."""
        return (self.until - self.since).total_seconds() / self.buckets


def quantities_of(text: str) -> tuple[str, ...]:
    """The quantities that a parameter names. Raises AskedWronglyError."""
    names = tuple(dict.fromkeys(name for name in text.split(",") if name))
    if not names or len(names) > MOST_QUANTITIES:
        msg = f"quantities: name 1 to {MOST_QUANTITIES}, as y_mm.main,temperature_main_c"
        raise AskedWronglyError(msg)
    for name in names:
        if not QUANTITY.fullmatch(name):
            msg = f"quantities: {name[:40]!r} is none; write them as y_mm.main,temperature_main_c"
            raise AskedWronglyError(msg)
    return names


def series(record: Record, pyramid: Pyramid, asked: Asked) -> dict[str, Any]:
    """The answer of `/api/series`. Raises StoreError."""
    narrow = asked.width_s < pyramid.lowest_s
    if narrow or asked.without_excluded:
        with record.reading() as connection:
            excluded = excluded_of(connection, asked.quantities) if asked.without_excluded else {}
            if narrow and (found := _from_rows(connection, asked, excluded)) is not None:
                return found
            if excluded:
                return _of_pyramid(pyramid, asked, BucketsWithout(connection, pyramid, excluded))
    return _of_pyramid(pyramid, asked)


def _from_rows(
    connection: sqlite3.Connection, asked: Asked, excluded: Excluded
) -> dict[str, Any] | None:
    """The rows, or buckets of them; None where they are too many to read."""
    since, until = (slot_text(next_second(time)) for time in (asked.since, asked.until))
    most = asked.buckets * ROWS_A_BUCKET + 1
    count = row_count(connection, since, until, most)
    if count == most:
        return None
    rows = chart_rows(connection, since, until, read_datums(connection), asked.quantities)
    rows = rows_without(rows, excluded)
    return _rows(asked, rows) if count <= asked.buckets else _of_rows(asked, rows)


def _head(asked: Asked, span_s: float) -> dict[str, Any]:
    return {
        "schema": 1,
        "since": seconds(asked.since),
        "until": seconds(asked.until),
        "span_s": span_s,
    }


def _rows(asked: Asked, rows: ChartRows) -> dict[str, Any]:
    nothing = np.full(len(rows.time_s), np.nan, np.float32)
    found = {
        name: {"value": rows.values.get(name, nothing).astype(np.float32)}
        for name in asked.quantities
    }
    return {**_head(asked, 0), "t": rows.time_s, "series": found, "flags": rows.flags}


def _of_rows(asked: Asked, rows: ChartRows) -> dict[str, Any]:
    width_s = max(math.ceil(asked.width_s), 1)
    first = math.floor(seconds(asked.since)) // width_s
    count = math.ceil(seconds(asked.until)) // width_s - first + 1
    place = rows.time_s // width_s - first
    found = {}
    for name in asked.quantities:
        values = rows.values.get(name)
        if values is None:
            found[name] = np.zeros(count, BUCKET)
            continue
        there = np.isfinite(values)
        found[name] = bucketed(place[there], values[there], count)
    return _of_buckets(asked, found, first * width_s, width_s)


def _of_pyramid(
    pyramid: Pyramid, asked: Asked, left: BucketsWithout | None = None
) -> dict[str, Any]:
    level, factor = level_for(pyramid, asked.width_s)
    width_s = pyramid.width_s(level) * factor
    first = (math.floor(seconds(asked.since)) - EPOCH_S) // width_s
    last = (math.ceil(seconds(asked.until)) - EPOCH_S - 1) // width_s
    count, start_s = last - first + 1, EPOCH_S + first * width_s
    found = {}
    for name in asked.quantities:
        found[name] = merged(pyramid.read(level, name, first * factor, count * factor), factor)
        if left is not None:
            found[name] = left.of(name, found[name], start_s, width_s)
    return _of_buckets(asked, found, start_s, width_s)


def level_for(pyramid: Pyramid, width_s: float) -> tuple[int, int]:
    """The level to read, and how many of its buckets make one that is not narrower."""
    level = 0
    while level + 1 < LEVELS and pyramid.width_s(level + 1) <= width_s:
        level += 1
    return level, max(math.ceil(width_s / pyramid.width_s(level)), 1)


def _of_buckets(
    asked: Asked, found: Mapping[str, Buckets], start_s: int, width_s: int
) -> dict[str, Any]:
    counts = [buckets["count"] for buckets in found.values()]
    there = np.flatnonzero(np.any(counts, axis=0))
    return {
        **_head(asked, width_s),
        "t": start_s + width_s * there.astype(np.int64),
        "series": {name: _arrays(buckets[there]) for name, buckets in found.items()},
    }


def _arrays(buckets: Buckets) -> dict[str, npt.NDArray[Any]]:
    nothing = buckets["count"] == 0
    arrays = {name: np.where(nothing, np.nan, buckets[name]) for name in ("min", "max", "mean")}
    return {
        **{name: values.astype(np.float32) for name, values in arrays.items()},
        "count": np.ascontiguousarray(buckets["count"]),
    }


# Spans


def spans(
    record: Record, pyramid: Pyramid, since: datetime, until: datetime, resolution_s: float
) -> dict[str, Any]:
    """The answer of `/api/spans`: gaps, runs of flags, datum links, events. Raises StoreError."""
    begin, end = (slot_text(next_second(time)) for time in (since, until))
    with record.reading() as connection:
        gaps = gaps_within(connection, begin, end, resolution_s / _CAUSE_SHARE)
        if resolution_s < pyramid.lowest_s and until - since < timedelta(days=40):
            flags = _runs(flagged_rows(connection, begin, end), resolution_s)
        else:
            flags = _runs_of_pyramid(pyramid, since, until, resolution_s)
        links = read_datums(connection).values()
        events = events_within(connection, since, until, 500)
        said = in_force(ledger_entries(connection))
    return {
        "schema": 1,
        "gaps": [
            {
                "start": seconds(gap.first_slot_utc),
                "end": seconds(gap.last_slot_utc) + gap.period_s,
                "slots": gap.slots,
                "cause": gap.cause.value,
            }
            for gap in gaps
        ],
        "flags": flags,
        "datum": [
            {
                "at": seconds(link.created_utc),
                "calibration": link.calibration_id,
                "offset": link.offset.mm.tolist(),
                "sigma": np.sqrt(np.diag(link.offset.covariance_mm2)).tolist(),
            }
            for link in links
            if since <= link.created_utc < until
        ],
        "events": [{"time": time, "kind": kind, "detail": detail} for time, kind, detail in events],
        "ledger": [
            entry_fields(one)
            for one in said
            if one.since_utc and one.until_utc and one.since_utc < until and one.until_utc > since
        ],
    }


def newest_entry(record: Record) -> int | None:
    """The number of the newest entry of the ledger. Raises StoreError."""
    with record.reading() as connection:
        found: int | None = value(connection, "SELECT max(id) FROM ledger")
    return found


def entry_fields(entry: LedgerEntry) -> dict[str, Any]:
    """What a person has said of a span."""
    return {
        "id": entry.id,
        "kind": entry.kind.value,
        "author": entry.author,
        "text": entry.text,
        "start": entry.since_utc,
        "end": entry.until_utc,
        "point": entry.point,
    }


def _runs(rows: Sequence[tuple[int, int, str]], resolution_s: float) -> list[dict[str, Any]]:
    """Rows that follow one another and say the same, those closer than the resolution as one."""
    runs: list[dict[str, Any]] = []
    said: tuple[int, str] | None = None
    for time_s, flag, reasons in rows:
        if flag == 1:
            if runs and time_s - runs[-1]["end"] >= resolution_s:
                said = None
            continue
        if (flag, reasons) == said:
            runs[-1]["end"] = time_s
            runs[-1]["count"] += 1
            continue
        said = (flag, reasons)
        words = [word for word in reasons.split("+") if word]
        run = {"start": time_s, "end": time_s, "flag": flag, "reasons": words, "count": 1}
        runs.append(run)
    return runs


def _runs_of_pyramid(
    pyramid: Pyramid, since: datetime, until: datetime, resolution_s: float
) -> list[dict[str, Any]]:
    level, factor = level_for(pyramid, resolution_s)
    width_s = pyramid.width_s(level)
    wide_s = width_s * factor
    first = (math.floor(seconds(since)) - EPOCH_S) // wide_s
    count = (math.ceil(seconds(until)) - EPOCH_S - 1) // wide_s - first + 1
    count = min(count, 100_000)
    masks: Masks = pyramid.read_masks(level, first * factor, count * factor)
    masks = np.bitwise_or.reduce(masks.reshape(-1, factor), axis=1)
    starts = np.flatnonzero(np.diff(masks, prepend=masks[:1] ^ np.uint64(1)))
    ends = np.append(starts[1:], len(masks))
    runs = []
    for begin, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if not masks[begin]:
            continue
        flag, reasons = said_by(int(masks[begin]))
        start_s = EPOCH_S + (first + begin) * wide_s
        until_s = EPOCH_S + (first + end) * wide_s
        runs.append({"start": start_s, "end": until_s, "flag": flag, "reasons": reasons})
    return runs
