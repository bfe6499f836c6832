"""A displacement beside a reference that others measured: whether they agree, and how well.

One axis at a time. The reference has few times, each with its own standard uncertainty: levelling,
a total station, LiDAR, a finite-element model. Normalised errors as in ISO 13528 and EA-4/02:
E_n = |d| / sqrt(U1^2 + U2^2), with the expanded uncertainties U of coverage factor 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from scipy.special import bdtr, ndtr, ndtri

from core.arrays import FloatArray, IntArray

COVERAGE_FACTOR = 2.0
"""Of both expanded uncertainties, by the convention of EA-4/02: some 95 %."""
NOT_SOUGHT = "none was sought"
_CHANCE = 0.05
"""Of calling two series different that are not."""
_LEAST_FOR_LAG = 10
"""Matched times below which no lag is sought: two numbers are fitted to them."""
_LAG_STEPS = 60
"""Lags tried to either side; the minimum is then interpolated."""
_BESIDE = 2
"""Lags to either side of the best one that a parabola is laid through."""
_STRETCHES = 10
"""Of the matched times, whose errors are taken to be independent of each other."""
_TOO_SMALL = "the movement is too small beside the uncertainties to show one"
_CLEAR = 9.0
"""How much worse the worst lag must fit than the best, in units of one observation's variance, for
a lag to mean anything: 3 sigma."""


class Zero(StrEnum):
    """What is known of the two systems' zeros."""

    FREE = "free"
    """Each has its own: the weighted mean of the differences is taken off."""
    FIXED = "fixed"
    """They are the same: a difference counts whole."""


@dataclass(frozen=True, slots=True)
class TimedValues:
    """One axis of a series, in the order of time; without NaN."""

    times_s: FloatArray
    """(n,) seconds since 1970."""
    values_mm: FloatArray
    """(n,)."""
    sigma_mm: FloatArray
    """(n,) standard uncertainty, k = 1."""

    def __len__(self) -> int:
        return len(self.times_s)


@dataclass(frozen=True, slots=True)
class Difference:
    """Rows about one time of the reference, less the reference."""

    time_s: float
    rows: int
    row_mm: float
    """Mean of the rows."""
    reference_mm: float
    difference_mm: float
    """Row less reference; with a free zero, less their weighted mean."""
    sigma_mm: float
    """Standard uncertainty of the difference."""
    e_n: float | None
    """None with a free zero and a single time: the zero takes all of it."""


@dataclass(frozen=True, slots=True)
class Lag:
    """How much later the reference shows a movement than the rows do."""

    lag_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """One axis of the rows beside the reference."""

    zero: Zero
    offset_mm: float
    """Taken off all differences; 0 with a fixed zero."""
    offset_sigma_mm: float
    differences: tuple[Difference, ...]
    unmatched: int
    """Times of the reference without a good row near them."""
    bias_mm: float
    """Mean of row less reference, before anything is taken off."""
    rms_mm: float
    """Of the differences, the offset off."""
    correlation: float | None
    """Of rows and reference (Pearson); None for fewer than three times or a constant series."""
    lag: Lag | None
    no_lag: str
    """Why there is no lag; empty where there is one."""
    beyond: int
    """Differences with E_n above 1."""
    largest_e_n: float | None
    agrees: bool | None
    """Whether the uncertainties explain the differences; None where that cannot be said."""

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        fields = {name: getattr(self, name) for name in Comparison.__slots__}
        lag = None if self.lag is None else {"lag_s": self.lag.lag_s, "sigma_s": self.lag.sigma_s}
        differences = [
            {name: getattr(one, name) for name in Difference.__slots__} for one in self.differences
        ]
        return fields | {"zero": self.zero.value, "lag": lag, "differences": differences}


def compare(
    rows: TimedValues,
    reference: TimedValues,
    *,
    window_s: float,
    zero: Zero = Zero.FREE,
    max_lag_s: float | None = None,
) -> Comparison | None:
    """Hold good rows against a reference; None where no time of it has a row near.

    Rows within window_s of a time are averaged. Their errors are taken to be one and the same (they
    share the calibration), so that a mean is no better than a row. A lag is sought up to max_lag_s
    either way, if given.

    >>> times_s = np.arange(0.0, 6000.0, 60.0)
    >>> rows = TimedValues(times_s, 0.001 * times_s, np.full(100, 0.05))
    >>> survey = TimedValues(np.array([600.0, 3000.0]), np.array([0.5, 2.9]), np.full(2, 0.1))
    >>> found = compare(rows, survey, window_s=60.0, zero=Zero.FIXED)
    >>> round(found.bias_mm, 3), round(found.largest_e_n, 3), found.agrees
    (0.1, 0.447, True)
    """
    counts, means, sigmas = _around(rows, reference.times_s, window_s)
    there = counts > 0
    if not there.any():
        return None
    raw_mm = means[there] - reference.values_mm[there]
    variance = sigmas[there] ** 2 + reference.sigma_mm[there] ** 2
    offset_mm, offset_variance = _offset(raw_mm, variance, zero)
    differences_mm, left = raw_mm - offset_mm, np.maximum(variance - offset_variance, 0.0)
    judged = zero is Zero.FIXED or len(raw_mm) > 1
    e_n = np.abs(differences_mm) / (COVERAGE_FACTOR * np.sqrt(left)) if judged else None
    lag, no_lag = _lag(rows, reference, window_s, max_lag_s)
    return Comparison(
        zero=zero,
        offset_mm=offset_mm,
        offset_sigma_mm=float(np.sqrt(offset_variance)),
        differences=tuple(
            Difference(
                float(reference.times_s[at]),
                int(counts[at]),
                float(means[at]),
                float(reference.values_mm[at]),
                float(differences_mm[k]),
                float(np.sqrt(left[k])),
                None if e_n is None else float(e_n[k]),
            )
            for k, at in enumerate(np.flatnonzero(there).tolist())
        ),
        unmatched=int((~there).sum()),
        bias_mm=float(raw_mm.mean()),
        rms_mm=float(np.sqrt((differences_mm**2).mean())),
        correlation=_correlation(means[there], reference.values_mm[there]),
        lag=lag,
        no_lag=no_lag,
        beyond=0 if e_n is None else int((e_n > 1.0).sum()),
        largest_e_n=None if e_n is None else float(e_n.max()),
        agrees=None if e_n is None else _agrees(e_n),
    )


def _around(
    rows: TimedValues, times_s: FloatArray, window_s: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Of the rows within window_s of each time (n,): how many, their mean, rms of their sigmas."""
    first = np.searchsorted(rows.times_s, times_s - window_s, side="left")
    end = np.searchsorted(rows.times_s, times_s + window_s, side="right")
    counts = np.asarray(end - first)
    middle = float(rows.values_mm.mean()) if len(rows) else 0.0  # sums of millions stay exact

    def means(values: FloatArray) -> FloatArray:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray((sums[end] - sums[first]) / np.maximum(counts, 1))

    shown = np.where(counts > 0, means(rows.values_mm - middle) + middle, np.nan)
    return counts, shown, np.sqrt(np.maximum(means(rows.sigma_mm**2), 0.0))


def _offset(raw_mm: FloatArray, variance: FloatArray, zero: Zero) -> tuple[float, float]:
    """What is taken off all differences, and its variance."""
    if zero is Zero.FIXED:
        return 0.0, 0.0
    weights = 1.0 / variance
    return float(weights @ raw_mm / weights.sum()), float(1.0 / weights.sum())


def _correlation(ours_mm: FloatArray, theirs_mm: FloatArray) -> float | None:
    if len(ours_mm) < 3 or not np.ptp(ours_mm) or not np.ptp(theirs_mm):
        return None
    return float(np.corrcoef(ours_mm, theirs_mm)[0, 1])


def _agrees(e_n: FloatArray) -> bool:
    """Whether not more, and none further, lie beyond 1 than chance lets expect of honest sigmas."""
    outside = 2.0 * ndtr(-COVERAGE_FACTOR)
    at_most = bdtr(np.arange(len(e_n) + 1), len(e_n), outside)
    allowed = np.searchsorted(at_most, 1.0 - _CHANCE)
    furthest = -ndtri(0.5 * _CHANCE / len(e_n)) / COVERAGE_FACTOR
    return bool((e_n > 1.0).sum() <= allowed and e_n.max() <= max(furthest, 1.0))


def _lag(
    rows: TimedValues, reference: TimedValues, window_s: float, max_lag_s: float | None
) -> tuple[Lag | None, str]:
    """The lag that leaves the smallest weighted squares, each lag with its own free zero."""
    if not max_lag_s:
        return None, NOT_SOUGHT
    lags = np.linspace(-max_lag_s, max_lag_s, 2 * _LAG_STEPS + 1)
    moved_s = reference.times_s - lags[:, None]
    usable = np.all([_around(rows, at, window_s)[0] > 0 for at in moved_s], axis=0)
    n = int(usable.sum())
    if n < _LEAST_FOR_LAG:
        return None, (
            f"{n} times of the reference have rows within the lags tried, {_LEAST_FOR_LAG} are "
            "needed"
        )
    theirs, sigma_mm = reference.values_mm[usable], reference.sigma_mm[usable]
    # Between rows, not their mean: a window that steps from row to row would move in steps, too.
    ours = [np.interp(at[usable], rows.times_s, rows.values_mm) for at in moved_s]
    weights = 1.0 / (float(np.mean(rows.sigma_mm**2)) + sigma_mm**2)
    misses = [theirs - mm for mm in ours]
    squares = np.array([weights @ (miss - weights @ miss / weights.sum()) ** 2 for miss in misses])
    best, one = int(np.argmin(squares)), max(1.0, float(squares.min()) / (n - 2))
    if squares.max() - squares.min() < _CLEAR * one:
        return None, _TOO_SMALL
    if not _BESIDE <= best < len(lags) - _BESIDE:
        return None, "it is longer than the lags tried"
    step_s, near = float(lags[1] - lags[0]), np.arange(-_BESIDE, _BESIDE + 1)
    curvature, slope, _ = np.polyfit(near, squares[best + near], 2).tolist()
    if curvature <= 0.0:
        return None, _TOO_SMALL
    lag_s = float(lags[best]) - step_s * 0.5 * slope / curvature
    by_step = (ours[best + _BESIDE] - ours[best - _BESIDE]) / (2 * _BESIDE)
    between = _between_blocks(misses[best], by_step, weights)
    return Lag(lag_s, step_s * max(math.sqrt(one / curvature), between)), ""


def _between_blocks(miss_mm: FloatArray, by_step: FloatArray, weights: FloatArray) -> float:
    """Standard error of a lag, in steps, from how much stretches of the record differ.

    Errors of rows an hour apart are often nearly one error: weather, light, a slow drift. So the
    scores are added up within stretches longer than that (cluster-robust; Cameron & Miller, J.
    Human Resources 50, 2015), which counts what they share.
    """
    miss_mm = miss_mm - weights @ miss_mm / weights.sum()
    by_step = by_step - weights @ by_step / weights.sum()
    scores = np.array(
        [part.sum() for part in np.array_split(weights * by_step * miss_mm, _STRETCHES)]
    )
    information = float(weights @ by_step**2)
    return math.sqrt(float(scores @ scores) * _STRETCHES / (_STRETCHES - 1)) / information
