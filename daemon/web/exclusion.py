"""Leaving out of the figures what the quality ledger excludes, as `plot --without-excluded` does.

Buckets hold all rows. One that lies in an excluded span goes; one that a span cuts is made again,
of the lowest buckets beside the span and of the rows of those that it cuts as well.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from core.arrays import FloatArray
from daemon.store.ledger.entries import Span, excluded_spans, ledger_entries, span_numbers
from daemon.store.queries.chart_rows import POINT_KEYS, ChartRows, chart_rows
from daemon.store.rows.datum import read_datums
from daemon.times import slot_text
from daemon.web.asking import seconds
from daemon.web.pyramid import BUCKET, EPOCH_S, Buckets, Pyramid, bucketed, merged

Excluded = Mapping[str, Sequence[Span]]
"""By quantity, in order and apart; quantities of which nothing is excluded are not there."""


def excluded_of(connection: sqlite3.Connection, quantities: Collection[str]) -> Excluded:
    """What the ledger excludes of the values of points: readings and the rig's motion stay."""
    entries = ledger_entries(connection)
    found = {}
    for name in quantities:
        key, _, point = name.partition(".")
        if key in POINT_KEYS and (spans := excluded_spans(entries, point)):
            found[name] = spans
    return found


def rows_without(rows: ChartRows, excluded: Excluded) -> ChartRows:
    """Rows as if the excluded values were not there."""
    times = rows.time_s.astype("datetime64[s]").astype("datetime64[us]")
    values = dict(rows.values)
    for name, spans in excluded.items():
        if (column := values.get(name)) is not None:
            values[name] = np.where(span_numbers(times, spans) >= 0, np.nan, column)
    return replace(rows, values=values)


class BucketsWithout:
    """Takes what is excluded out of buckets of the pyramid."""

    def __init__(
        self, connection: sqlite3.Connection, pyramid: Pyramid, excluded: Excluded
    ) -> None:
        self._connection, self._pyramid, self._excluded = connection, pyramid, excluded
        self._datums = read_datums(connection)
        self._rows: dict[int, Mapping[str, FloatArray]] = {}

    def of(self, name: str, buckets: Buckets, start_s: int, width_s: int) -> Buckets:
        """Buckets of a quantity, from a time on."""
        spans = self._excluded.get(name, ())
        return _left(
            buckets, start_s, width_s, spans, lambda at_s: self._again(name, at_s, width_s)
        )

    def _again(self, name: str, start_s: int, width_s: int) -> Buckets:
        """(1,) a bucket that a span cuts, of the lowest ones in it."""
        lowest_s = self._pyramid.lowest_s
        count = width_s // lowest_s
        lowest = self._pyramid.read(0, name, (start_s - EPOCH_S) // lowest_s, count)
        left = _left(
            *(lowest, start_s, lowest_s, self._excluded[name]),
            lambda at_s: self._of_rows(name, at_s),
        )
        return merged(left, count)

    def _of_rows(self, name: str, start_s: int) -> Buckets:
        if start_s not in self._rows:
            ends_s = start_s, start_s + self._pyramid.lowest_s
            since, until = (slot_text(datetime.fromtimestamp(end_s, UTC)) for end_s in ends_s)
            rows = chart_rows(self._connection, since, until, self._datums, self._excluded)
            self._rows[start_s] = rows_without(rows, self._excluded).values
        values = self._rows[start_s].get(name, np.zeros(0))
        values = values[np.isfinite(values)]
        return bucketed(np.zeros(len(values), np.int64), values, 1)


def _left(
    buckets: Buckets,
    start_s: int,
    width_s: int,
    spans: Sequence[Span],
    again: Callable[[int], Buckets],
) -> Buckets:
    """Buckets without those in a span; `again` makes one that a span cuts, by its time."""
    found, cut = buckets.copy(), set()
    for span in spans:
        low, high = ((seconds(when) - start_s) / width_s for when in span)
        found[max(math.ceil(low), 0) : max(math.floor(high), 0)] = np.zeros((), BUCKET)
        cut |= {math.floor(end) for end in (low, high) if end % 1.0}
    for place in cut:
        if 0 <= place < len(found) and found["count"][place]:
            found[place] = again(start_s + place * width_s)[0]
    return found
