"""How far bridge and rig move of their own in a stretch without rows, as the record shows it."""

from __future__ import annotations

import math

import numpy as np

from core.arrays import FloatArray

_FEWEST_PAIRS = 8
"""Pairs of rows that tell of a lag; with fewer, longer lags are looked at."""
_FEWEST_ROWS = 4
"""Fewer rows tell nothing of how far a bridge moves."""
_WIDER = 1.5
"""Lags up to so many times the gap stand for it."""
_LEAST_LAG_S = 1.0
_SETTLES_S = 4.0 * 3600.0
"""After which a rig has left where it was. Chosen: sun and clouds turn a rig within hours; with a
day instead, as of a wave that comes once a day, the movement of an hour would be half as large."""
_MEDIAN_SQUARE = 0.4549
"""The median of the square of a standard normal variable."""


def movement_sigma_mm(times_s: FloatArray, mm: FloatArray, gap_s: float) -> FloatArray | None:
    """(2,) 1 sigma of the movement within a gap; None where the record tells nothing.

    times_s (n,) in order, mm (n, 2). From the differences of rows that far apart; where there are
    none, of the next longer lag; and where the gap is longer than the record, from the spread.
    """
    if len(times_s) < _FEWEST_ROWS:
        return None
    lag_s = max(gap_s, _LEAST_LAG_S)
    while lag_s <= times_s[-1] - times_s[0]:
        found = _differences(times_s, mm, lag_s)
        if len(found) >= _FEWEST_PAIRS:
            return np.asarray(np.sqrt(np.median(found**2, axis=0) / _MEDIAN_SQUARE))
        if len(found) >= _FEWEST_ROWS - 1:
            return np.asarray(np.sqrt((found**2).mean(axis=0)))
        lag_s *= _WIDER
    return math.sqrt(2.0) * np.asarray(mm.std(axis=0, ddof=1))


def drift_sigma_mm(times_s: FloatArray, mm: FloatArray, gap_s: float) -> FloatArray | None:
    """(k,) 1 sigma of a rig's movement within a gap; None where the record tells nothing.

    times_s (n,) in order, mm (n, k). From the differences of rows that far apart; where there are
    too few, from the spread of all, of which a gap of hours brings a part only.
    """
    if len(times_s) < _FEWEST_ROWS:
        return None
    found = _differences(times_s, mm, max(gap_s, _LEAST_LAG_S))
    if len(found) >= _FEWEST_PAIRS:
        return np.asarray(np.sqrt((found**2).mean(axis=0)))
    return drift_share(gap_s) * np.asarray(mm.std(axis=0, ddof=1))


def drift_share(gap_s: float) -> float:
    """1 sigma of a rig's movement within a gap, over that of where it is."""
    return math.sqrt(-2.0 * math.expm1(-gap_s / _SETTLES_S))


def _differences(times_s: FloatArray, mm: FloatArray, lag_s: float) -> FloatArray:
    """(k, 2) differences of rows that are apart by the lag, or up to `_WIDER` times it."""
    later = np.searchsorted(times_s, times_s + lag_s)
    near = np.minimum(later, len(times_s) - 1)
    far_s = times_s[near] - times_s
    usable = (later < len(times_s)) & (far_s <= _WIDER * lag_s) & (far_s > 0.0)
    return np.asarray(mm[near[usable]] - mm[usable])
