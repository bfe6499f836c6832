"""The trend of a record: mm a year, with season, temperature and known steps fitted beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.analysis.noise import DAY_S, Noise
from core.analysis.regression import (
    YEAR_DAYS,
    Fit,
    Interval,
    Mixture,
    daily,
    independent,
    robust_fit,
    yearly,
)
from core.arrays import BoolArray, FloatArray

MEMORIES_DAYS = ((0.03, 2.0), (2.0, 200.0))
"""Bounds of the noise's memories: a trend must not take weeks of weather for itself."""
LEAST_DAYS = 5.0
"""A shorter record has no trend worth a number."""


@dataclass(frozen=True, slots=True)
class Trend:
    """A straight line beside season, temperature and steps."""

    mm_per_year: Interval
    noise: Noise
    left_out: int
    """Single bad values."""
    seasonal: bool
    """Whether a year's cycle was fitted; otherwise the trend may be a part of one."""
    keep: BoolArray
    """(n,) values that were used."""
    line_mm: FloatArray
    """(n,) constant and trend alone."""
    rest_mm: FloatArray
    """(n,) values less all that was fitted but constant and trend."""


def trend_of(
    times_s: FloatArray,
    values_mm: FloatArray,
    beside: FloatArray | None = None,
    *,
    confidence: float = 0.95,
    with_days: bool = True,
) -> Trend:
    """Fit a line to values (n,) at increasing times, with further columns (n, k) beside it.

    `with_days` fits a daily cycle, for values several times a day.
    """
    times_days = (times_s - times_s[0]) / DAY_S
    further = [yearly(times_s)]
    if with_days:
        further.append(daily(times_s))
    if beside is not None:
        further.append(beside)
    line = np.column_stack([np.ones(len(times_s)), times_days / YEAR_DAYS])
    columns = np.column_stack(further)
    design = independent(np.column_stack([line, columns - columns.mean(axis=0)]))
    fit = robust_fit(times_days, design, values_mm, MEMORIES_DAYS)
    unit = np.zeros(design.shape[1])
    unit[1] = 1.0
    keep = fit.keep
    mixture = Mixture.of(
        fit.noise_fit, times_days[keep], design[keep], values_mm[keep], MEMORIES_DAYS
    )
    line_mm = line @ fit.gls.coefficients[:2]
    return Trend(
        mixture.interval(unit, confidence),
        fit.noise,
        int((~fit.keep).sum()),
        further[0].shape[1] > 0,
        fit.keep,
        line_mm,
        values_mm - design[:, 2:] @ fit.gls.coefficients[2:],
    )


@dataclass(frozen=True, slots=True)
class Difference:
    """The level after an event less that before."""

    mm: Interval
    raw_mm: float
    """Difference of the plain means, nothing regressed out."""
    before: int
    """Values before."""
    after: int
    noise: Noise


def difference(
    times_s: FloatArray,
    values_mm: FloatArray,
    event_s: float,
    beside: FloatArray | None = None,
    *,
    confidence: float = 0.95,
) -> Difference:
    """The mean level after a known time less that before; further columns (n, k) beside it.

    A drift on either side is a part of it, not noise: each side has a line about its own mean.
    A day's cycle is fitted where both sides show it. Raises ValueError where less than three values
    are on one side.
    """
    after = times_s >= event_s
    if min(int(after.sum()), int((~after).sum())) < _LEAST_A_SIDE:
        msg = f"fewer than {_LEAST_A_SIDE} values before or after the event"
        raise ValueError(msg)
    times_days = (times_s - times_s[0]) / DAY_S
    columns = [_about_mean(times_days, side) for side in (~after, after)]
    if beside is not None:
        columns.append(beside - beside.mean(axis=0))
    if min(event_s - times_s[0], times_s[-1] - event_s) > 2.0 * DAY_S:
        columns.append(daily(times_s))
    step = after.astype(np.float64)
    design = independent(np.column_stack([np.ones(len(times_s)), step, *columns]))
    fit: Fit = robust_fit(times_days, design, values_mm)
    unit = np.zeros(design.shape[1])
    unit[1] = 1.0
    keep = fit.keep
    mixture = Mixture.of(fit.noise_fit, times_days[keep], design[keep], values_mm[keep])
    return Difference(
        mixture.interval(unit, confidence),
        float(np.mean(values_mm[after]) - np.mean(values_mm[~after])),
        int((~after).sum()),
        int(after.sum()),
        fit.noise,
    )


def _about_mean(times_days: FloatArray, side: BoolArray) -> FloatArray:
    """(n, 1) a line on one side of an event about its own mean; (n, 0) where the side is short."""
    if np.ptp(times_days[side]) < _LINE_DAYS:
        return np.empty((len(times_days), 0))
    return np.where(side, times_days - times_days[side].mean(), 0.0)[:, None]


_LINE_DAYS = 5.0
"""Days of a side of an event from which on it has a line. Chosen."""
_LEAST_A_SIDE = 3
"""Values on a side of an event below which there is no level."""
