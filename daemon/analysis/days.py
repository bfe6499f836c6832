"""The days of a place's calendar: lowest, mean and highest good value, and how complete each is."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime, time, timedelta, tzinfo

import numpy as np

from core.analysis.binning import bins_of
from core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Day:
    """The good rows of a day."""

    day: date
    lowest_mm: float
    """NaN without a good row, as the others."""
    mean_mm: float
    highest_mm: float
    rows: int
    completeness: float
    """Share of the slots that lay in the day, and in the span, that have a good row."""


def days_of(
    times_s: FloatArray,
    values_mm: FloatArray,
    zone: tzinfo,
    period_s: float,
    span: tuple[datetime, datetime],
) -> tuple[Day, ...]:
    """Each day of a zone within a span; times (rows,), values (rows,) NaN if not good."""
    first, last = (when.astimezone(zone).date() for when in (span[0], span[1]))
    count = (last - first).days + 1
    names = [first + timedelta(days=number) for number in range(count + 1)]
    edges_s = np.array([_midnight_s(day, zone) for day in names])
    bins = bins_of(times_s, values_mm, edges_s)
    begin_s, end_s = span[0].timestamp(), span[1].timestamp()
    inside = np.minimum(edges_s[1:], end_s) - np.maximum(edges_s[:-1], begin_s)
    expected = np.maximum(inside / period_s, 1.0)
    return tuple(
        Day(
            names[number],
            float(bins.lowest[number]),
            float(bins.mean[number]),
            float(bins.highest[number]),
            int(bins.count[number]),
            min(1.0, float(bins.count[number] / expected[number])),
        )
        for number in range(count)
        if inside[number] > 0.0
    )


def _midnight_s(day: date, zone: tzinfo) -> float:
    return datetime.combine(day, time(), zone).timestamp()
