"""When a value is beyond a limit, or changes faster than one, by more than its noise explains.

Level. Of the rows of the dwell time, `v` is the median of the values and `s` the median of their
sigmas. `s` is not divided by the number of rows: most of a row's sigma is shared by its neighbours
(calibration, turning of the rig). Above a limit `L` the alarm is raised where

    v - k s > L

and cleared where `v < L - h`, with the hysteresis `h`; below a limit the same with signs changed.
So one row, whatever it says, neither raises nor clears an alarm.

Rate. The rows of the window are averaged over 24 or more blocks, and a straight line is fitted by
weighted least squares (weights 1 / s_i^2), from two days on together with the daily cycle:

    y(t) = a + b t + sum_{m = 1, 2} (c_m cos(m w t) + d_m sin(m w t)),   w = 2 pi / 1 d

    s_b^2 = C_bb max(1, chi^2 / (n - p) (1 + r) / (1 - r))

`C` is the covariance of the fit, `r` the correlation of neighbouring residuals where it is positive
(what is left of weather is no white noise). Raised where `|b| - k s_b > L`, cleared where
`|b| < L - h`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray

LEAST_ROWS = 3
"""Fewer rows say nothing about a level: the alarm stays as it is."""
DAY_S = 86_400.0
"""The cycle that sun and traffic have, and the unit of a rate."""
BLOCK_S = 3600.0
"""Of rows that are averaged before a line is fitted."""
LEAST_BLOCKS = 12
"""With rows, of those of a window: fewer say nothing about a rate."""
LEAST_SHARE = 0.7
"""Of the window, between its first and its last row."""
CYCLE_FROM_S = 2 * DAY_S
"""Windows that show the daily cycle twice are fitted with it."""
MOST_CORRELATION = 0.95
"""Of neighbouring residuals: more cannot be told from a trend in one window."""


@dataclass(frozen=True, slots=True)
class Samples:
    """A value in order of time, of the rows that are believed."""

    time_s: FloatArray
    """(n,) since any epoch."""
    value: FloatArray
    """(n,)."""
    sigma: FloatArray
    """(n,) 1 sigma of each value, in its unit."""

    def since(self, time_s: float) -> Samples:
        """Those later than a time."""
        later = self.time_s > time_s
        return Samples(self.time_s[later], self.value[later], self.sigma[later])


@dataclass(frozen=True, slots=True)
class Limits:
    """Beyond what a value is an alarm."""

    above: float | None
    below: float | None
    hysteresis: float
    sigmas: float
    """k: how many sigmas a value must be beyond a limit."""


@dataclass(frozen=True, slots=True)
class Judged:
    """What was found."""

    value: float
    sigma: float
    limit: float | None
    """The limit that it is beyond; None where there is no alarm."""
    rows: int
    until_s: float
    """The last row."""


def judge_level(
    samples: Samples, limits: Limits, dwell_s: float, raised: float | None
) -> Judged | None:
    """Judge the rows of the dwell time, or the last `LEAST_ROWS` where rows are further apart.

    `raised` is the limit for which the alarm is raised now. None where there are too few rows to
    say anything.
    """
    if samples.time_s.size < LEAST_ROWS:
        return None
    last_s = float(samples.time_s[-1])
    begin_s = min(last_s - dwell_s, float(np.nextafter(samples.time_s[-LEAST_ROWS], -math.inf)))
    used = samples.since(begin_s)
    value, sigma = float(np.median(used.value)), float(np.median(used.sigma))
    limit = _limit(value, sigma, limits, raised)
    return Judged(value, sigma, limit, used.time_s.size, last_s)


def judge_rate(
    samples: Samples,
    limit: float,
    hysteresis: float,
    sigmas: float,
    window_s: float,
    *,
    raised: bool,
) -> Judged | None:
    """Judge the rate over the last `window_s`, in the value's unit a day.

    None where too much of the window is missing.
    """
    fitted = fit_rate(samples, window_s)
    if fitted is None:
        return None
    rate, sigma = fitted
    # Whichever way it goes.
    limits = Limits(limit, -limit, hysteresis, sigmas)
    held = math.copysign(limit, rate) if raised else None
    found = _limit(rate, sigma, limits, held)
    return Judged(rate, sigma, found, samples.time_s.size, float(samples.time_s[-1]))


def fit_rate(samples: Samples, window_s: float) -> tuple[float, float] | None:
    """Rate a day and its sigma over the last `window_s`; None where too much is missing."""
    if not samples.time_s.size:
        return None
    used = samples.since(float(samples.time_s[-1]) - window_s)
    if used.time_s[-1] - used.time_s[0] < LEAST_SHARE * window_s:
        return None
    time_s, value, sigma, block = _blocks(used, min(BLOCK_S, window_s / (2 * LEAST_BLOCKS)))
    if time_s.size < LEAST_BLOCKS:
        return None
    days = (time_s - time_s.mean()) / DAY_S
    columns = [np.ones_like(days), days]
    if window_s >= CYCLE_FROM_S:
        for harmonic in (1, 2):
            angle = 2 * math.pi * harmonic * days
            columns += [np.cos(angle), np.sin(angle)]
    design = np.column_stack(columns) / sigma[:, None]
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    covariance = np.linalg.inv(design.T @ design)
    solution = covariance @ (design.T @ (value / sigma))
    residual = value / sigma - design @ solution
    scatter = float(residual @ residual) / max(1, days.size - design.shape[1])
    correlation = _correlation(residual, block)
    inflation = max(1.0, scatter * (1 + correlation) / (1 - correlation))
    return float(solution[1]), math.sqrt(float(covariance[1, 1]) * inflation)


def _limit(value: float, sigma: float, limits: Limits, raised: float | None) -> float | None:
    """The limit that a value is beyond, or still is."""
    reach = limits.sigmas * sigma
    above, below = limits.above, limits.below
    if above is not None:
        held = raised == above and value >= above - limits.hysteresis
        if held or value - reach > above:
            return above
    if below is not None:
        held = raised == below and value <= below + limits.hysteresis
        if held or value + reach < below:
            return below
    return None


def _blocks(
    samples: Samples, block_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean time, mean value, mean sigma and number of each block that has rows."""
    number = np.floor(samples.time_s / block_s)
    blocks, of_block = np.unique(number, return_inverse=True)
    count = np.bincount(of_block).astype(float)
    means = [
        np.bincount(of_block, values) / count
        for values in (samples.time_s, samples.value, np.maximum(samples.sigma, 1e-9))
    ]
    return means[0], means[1], means[2], blocks


def _correlation(residual: FloatArray, block: FloatArray) -> float:
    """Of residuals of neighbouring blocks, from 0 on."""
    next_to = np.diff(block) == 1
    if not next_to.any():
        return 0.0
    square = float(np.mean(residual**2))
    if square == 0.0:
        return 0.0
    product = float(np.mean((residual[:-1] * residual[1:])[next_to]))
    return min(max(product / square, 0.0), MOST_CORRELATION)
