"""A reading behind its lag: means over hours, and how well they are known beside its gaps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg.lapack import dtbtrs

from core.analysis.binning import FINE_S, HOUR_S, Hours
from core.analysis.reading_course import estimated
from core.arrays import BoolArray, FloatArray, IntArray

_HALF_DAY = 72
"""Places of the grid in 12 hours."""
_SPREAD_PLACES = np.unique(np.geomspace(1, 720, 25).astype(int))
"""Places of the grid, up to 5 days, at which it is asked how far a reading changes."""
_PAST = 78
"""Places of the grid before and after the readings: 13 hours, more than any shift."""
_NEAR = 3
"""Places of the grid in half an hour."""
_START = 144
"""Values of the grid whose mean is what was before the first: a day."""


class Lag(StrEnum):
    """How a displacement comes after a reading."""

    SHIFT = "shift"
    FIRST_ORDER = "first-order"


@dataclass(frozen=True, slots=True)
class Spans:
    """Over what a reading is averaged to stand beside the mean of an hour's rows."""

    times_s: FloatArray
    """(n,) middles."""
    span_s: FloatArray
    """(n,) lengths."""

    @classmethod
    def of(cls, hours: Hours) -> Spans:
        """Those of hourly means."""
        return cls(hours.times_s, hours.span_s)

    def kept(self, keep: BoolArray) -> Spans:
        """Those that are marked."""
        return Spans(self.times_s[keep], self.span_s[keep])


@dataclass(frozen=True, slots=True)
class _Course:
    """Values on a regular grid."""

    edges_s: FloatArray
    """(m + 1,) of the spans."""
    values: FloatArray
    """(m,) means of the spans."""
    before: float
    """What was there before the first."""
    total: BSpline
    """The values' integral over time: known at the edges, smooth in between."""

    @classmethod
    def of(cls, grid_s: FloatArray, values: FloatArray, before: float) -> _Course:
        """By the middles (m,) of the spans."""
        edges_s = np.append(grid_s - 0.5 * FINE_S, grid_s[-1] + 0.5 * FINE_S)
        total = np.append(0.0, np.cumsum(values)) * FINE_S
        return cls(edges_s, values, before, make_interp_spline(edges_s, total, k=3))

    def after(self, hours: Spans, kind: Lag, lag_h: float) -> FloatArray:
        """(n,) its means, behind a lag, over the spans of these hours.

        Of a shift the change of the integral over the span; of a first-order lag F, with
        lag dF/dt = T - F, that of T less lag times the change of F.
        """
        ends_s = hours.times_s[:, None] + np.array([-0.5, 0.5]) * hours.span_s[:, None]
        shift_s = lag_h * HOUR_S if kind is Lag.SHIFT else 0.0
        change = np.diff(self.total(ends_s - shift_s))[:, 0]
        if kind is Lag.FIRST_ORDER:
            left = np.exp(-FINE_S / HOUR_S / lag_h)
            lagged = _first_order(left, self.values - self.before)
            ends = np.interp(ends_s, self.edges_s, np.append(0.0, lagged))
            change -= lag_h * HOUR_S * np.diff(ends)[:, 0]
        found: FloatArray = change / hours.span_s
        return found


@dataclass(frozen=True, slots=True)
class Reading:
    """A reading, interpolated where it is not known."""

    course: _Course
    error: _Course
    """Its standard error: none where it is known."""
    usual: float
    """Its usual change within 12 hours."""

    def after(self, hours: Spans, kind: Lag, lag_h: float) -> FloatArray:
        """(n,) its means, behind a lag, over the spans of these hours."""
        return self.course.after(hours, kind, lag_h)

    def unsure(self, hours: Spans, kind: Lag, lag_h: float) -> FloatArray:
        """(n,) how wrong these are, as a share of its usual change."""
        return self.error.after(hours, kind, lag_h) / max(self.usual, np.finfo(float).tiny)


def reading_of(hours: Hours, channel: int) -> Reading:
    """A reading on its grid, and by how much it may have changed where it is not known."""
    there = np.isfinite(hours.readings[:, channel])
    grid_s = hours.fine_s[0] + FINE_S * np.arange(-_PAST, len(hours.fine_s) + _PAST)
    apart = _apart(np.flatnonzero(there) + _PAST, len(grid_s))
    best = estimated(hours.readings[:, channel], apart[_PAST:-_PAST] <= _NEAR)
    there = np.isfinite(best)
    values = np.interp(grid_s, hours.fine_s[there], best[there])
    values -= float(np.mean(values))
    change = _changes(hours.readings[:, channel])
    error = np.where(apart > 0, np.interp(apart, _SPREAD_PLACES, change) / np.sqrt(2.0), 0.0)
    return Reading(
        _Course.of(grid_s, values, float(np.mean(values[_PAST : _PAST + _START]))),
        _Course.of(grid_s, error, float(change[-1])),
        float(np.interp(_HALF_DAY, _SPREAD_PLACES, change)),
    )


def known_share(hours: Hours, channel: int) -> float:
    """Share of the record that is within half an hour of a value: slots may be an hour apart."""
    places = np.flatnonzero(np.isfinite(hours.readings[:, channel]))
    if not len(places):
        return 0.0
    return float(np.mean(_apart(places, len(hours.readings)) <= _NEAR))


def _first_order(left: float, values: FloatArray) -> FloatArray:
    """(n,) y[i] = left y[i - 1] + (1 - left) values[i], from rest: a band of equations."""
    band = np.ones((2, len(values)))
    band[1] = -left
    found, _ = dtbtrs(band, (1.0 - left) * values[:, None], uplo="L")
    return np.asarray(found[:, 0], dtype=np.float64)


def _changes(values: FloatArray) -> FloatArray:
    """(places,) root mean square change of a reading between values so far apart.

    Interpolated where no two values are just so far apart, as with a slot an hour.
    """
    known = [(0, 0.0)]
    for apart in _SPREAD_PLACES.tolist():
        moved = values[apart:] - values[:-apart]
        if np.isfinite(moved).any():
            known.append((apart, float(np.sqrt(np.nanmean(moved**2)))))
    places, changes = np.array(known).T
    found: FloatArray = np.interp(_SPREAD_PLACES, places, changes)
    return found


def _apart(places: IntArray, n: int) -> FloatArray:
    """(n,) distance of each place of a grid to the nearest of some places, in increasing order."""
    at = np.arange(n)
    after = np.clip(np.searchsorted(places, at), 0, len(places) - 1)
    before = np.maximum(after - 1, 0)
    found: FloatArray = np.minimum(np.abs(places[after] - at), np.abs(places[before] - at))
    return found
