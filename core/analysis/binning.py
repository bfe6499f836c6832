"""Rows of minutes reduced to days and hours: few enough to fit, and robust to single rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray

HOUR_S = 3600.0
"""What one mean of a `Hours` spans."""
FINE_S = 600.0
"""Grid of the readings behind it: a lag is applied before the mean is taken."""
_FULL_SHARE = 0.25
"""Rows that an hour must have, as a share of the usual number: the mean of fewer is not that of the
hour where the bridge moves by a millimetre in it. Chosen."""
_OUTLYING = 5.0
"""Standard deviations from its hour's median beyond which a row is left out of the mean. Chosen: of
normal rows one in two million."""
_LEAST_S2 = 60.0**2 / 12.0
"""Variance of times that a mean's rows have at least: one of its own minute."""
_MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


@dataclass(frozen=True, slots=True)
class Bins:
    """Figures of the rows between consecutive edges; NaN where there is none."""

    lowest: FloatArray
    """(n,)."""
    mean: FloatArray
    """(n,)."""
    highest: FloatArray
    """(n,)."""
    count: IntArray
    """(n,) rows with a value."""


@dataclass(frozen=True, slots=True)
class Hours:
    """Robust means of the hours that have enough rows."""

    times_s: FloatArray
    """(n,) mean time of the rows, increasing."""
    mean_mm: FloatArray
    """(n,)."""
    count: IntArray
    """(n,) rows that made the mean."""
    span_s: FloatArray
    """(n,) length of the span over which a reading's course, on its grid, has the same mean as at
    the rows: an hour if they are many, the grid's own for a single row."""
    fine_s: FloatArray
    """(m,) mean times of the readings' own spans, a regular grid."""
    readings: FloatArray
    """(m, channels) means of all rows; NaN where there is none."""

    def __len__(self) -> int:
        return len(self.times_s)

    def kept(self, keep: BoolArray) -> Hours:
        """Those that are marked."""
        return replace(
            self,
            times_s=self.times_s[keep],
            mean_mm=self.mean_mm[keep],
            count=self.count[keep],
            span_s=self.span_s[keep],
        )


def bins_of(times_s: FloatArray, values: FloatArray, edges_s: FloatArray) -> Bins:
    """Lowest, mean, highest and number of `values` (rows,) from each edge to the next.

    >>> found = bins_of(np.array([0.0, 1.0, 2.0]), np.array([4.0, 2.0, 7.0]), np.array([0.0, 2, 4]))
    >>> found.mean.tolist(), found.count.tolist()
    ([3.0, 7.0], [2, 1])
    """
    n = len(edges_s) - 1
    inside = np.isfinite(values) & (times_s >= edges_s[0]) & (times_s < edges_s[-1])
    values = values[inside]
    bins = np.searchsorted(edges_s, times_s[inside], side="right") - 1
    lowest, highest = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(lowest, bins, values)
    np.maximum.at(highest, bins, values)
    count = np.bincount(bins, minlength=n)
    total = np.bincount(bins, weights=values, minlength=n)
    empty = count == 0
    return Bins(
        np.where(empty, np.nan, lowest),
        np.where(empty, np.nan, total / np.maximum(count, 1)),
        np.where(empty, np.nan, highest),
        count.astype(np.int64),
    )


def hours_of(
    times_s: FloatArray, values_mm: FloatArray, readings: FloatArray, bin_s: float = HOUR_S
) -> Hours:
    """Means of the good rows of each hour, rows far from their hour's median left out.

    times_s, values_mm (rows,), readings (rows, channels). Rows without a value count for nothing.
    """
    fine_s, fine, fine_s2 = _fine(times_s, readings)
    good = np.isfinite(values_mm)
    times_s, values_mm = times_s[good], values_mm[good]
    named, bins = np.unique(np.floor(times_s / bin_s).astype(np.int64), return_inverse=True)
    n = len(named)
    middle = _medians(values_mm, bins, n)
    spread = _medians(np.abs(values_mm - middle[bins]), bins, n) * _MAD_TO_SIGMA
    typical = float(np.median(spread)) if n else 0.0  # an hour of equal rows has no spread
    limit = _OUTLYING * np.maximum(spread, typical)
    inlying = np.abs(values_mm - middle[bins]) <= limit[bins]
    bins = bins[inlying]
    count = np.bincount(bins, minlength=n)

    def mean(values: FloatArray) -> FloatArray:
        return np.bincount(bins, weights=values, minlength=n) / np.maximum(count, 1)

    middles_s = mean(times_s[inlying])
    spread_s2 = mean((times_s[inlying] - middles_s[bins]) ** 2)
    hours = Hours(
        times_s=middles_s,
        mean_mm=mean(values_mm[inlying]),
        count=count.astype(np.int64),
        span_s=np.sqrt(12.0 * np.maximum(spread_s2 + fine_s2, _LEAST_S2)),
        fine_s=fine_s,
        readings=fine,
    )
    usual = float(np.median(count)) if n else 0.0
    return hours.kept((count >= _FULL_SHARE * usual) & (count > 0))


def _fine(times_s: FloatArray, readings: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Times (m,) and means (m, channels) of the readings on a regular grid; variance short of it.

    A mean belongs to the mean time of its rows, and that is not the middle of its span: rows of
    full minutes lie 30 s before it. Nor do its rows spread over all of the span, as a course does
    of which it is taken to be the mean: by so much is the variance of their times less.
    """
    if not len(times_s):
        return np.empty(0), np.empty((0, readings.shape[1])), 0.0
    first = np.floor(times_s[0] / FINE_S)
    edges_s = np.arange(first, np.floor(times_s[-1] / FINE_S) + 2.0) * FINE_S
    middles_s = edges_s[:-1] + 0.5 * FINE_S
    offsets_s = bins_of(times_s, times_s, edges_s).mean - middles_s
    places = np.searchsorted(edges_s, times_s, side="right") - 1
    about_s2 = (times_s - middles_s[places] - offsets_s[places]) ** 2
    spread_s2 = float(np.nanmedian(bins_of(times_s, about_s2, edges_s).mean))
    fine_s = middles_s + np.nanmedian(offsets_s)
    found = np.full((len(fine_s), readings.shape[1]), np.nan)
    for channel, column in enumerate(readings.T):
        means = bins_of(times_s, column, edges_s)
        there = means.count > 0
        if there.any():
            when_s = bins_of(times_s, np.where(np.isfinite(column), times_s, np.nan), edges_s).mean
            found[there, channel] = np.interp(fine_s[there], when_s[there], means.mean[there])
    return fine_s, found, FINE_S**2 / 12.0 - spread_s2


def _medians(values: FloatArray, bins: IntArray, n: int) -> FloatArray:
    """(n,) median of the values in each bin; every bin has one."""
    order = np.lexsort((values, bins))
    count = np.bincount(bins, minlength=n)
    first = np.cumsum(count) - count
    ordered = values[order]
    lower, upper = first + (count - 1) // 2, first + count // 2
    found: FloatArray = 0.5 * (ordered[lower] + ordered[upper])
    return found
