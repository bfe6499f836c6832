"""Least squares with noise that remembers, single bad values left out, further columns tried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtr, stdtrit

from core.analysis.noise import (
    AT_ONCE,
    DAY_S,
    MEMORIES_DAYS,
    Gls,
    Noise,
    NoiseFit,
    Whitening,
    fit_noise,
    other_noises,
)
from core.arrays import BoolArray, FloatArray

YEAR_DAYS = 365.25
"""Mean length of a year."""
_DAILY = (1, 2)
"""Harmonics of the day: its length and half of it."""
_YEARLY = (1, 2)
"""Harmonics of the year."""
LEAST_SEASON_DAYS = 1.5 * YEAR_DAYS
"""A shorter record cannot tell a year's cycle from a trend. Chosen."""
_OUTLYING = 5.0
"""Robust standard deviations beyond which a value that neither side explains is left out."""
_PASSES = 3
"""Searches for single bad values: a big one hides smaller ones."""
_MOST_OUT = 0.05
"""Share of the values that may be left out in one pass."""
_MAD_TO_SIGMA = 1.4826
"""As in `binning`."""
_BLOCKS = 20
"""Stretches of a record that are left out in turn. Chosen: their spread is known to 16 %."""
_LEAST_BLOCKS = 8
"""Fewer say little of a spread."""
_NOT_THERE = 1e-9
"""Of a column that shows in one stretch alone, such as the first hours of creep, what the others
know of it, at most: without that stretch it is left out."""
_ITS_OWN = 1e-5
"""Share of a column that others must not contain: of 10 mm of creep that is less than counts, and
the equations keep ten digits' room."""
_BLOCK_DAYS = 2.0
"""Of a stretch at least: longer than what hours and the sun's daily course leave."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with its standard deviation and a two-sided interval."""

    value: float
    sigma: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Mixture:
    """Coefficients of a design, under each noise that the values allow."""

    fits: tuple[Gls, ...]
    shares: FloatArray
    """(fits,) probabilities."""
    degrees: float
    """Of freedom of each fit's variance."""

    @classmethod
    def of(
        cls,
        fit: NoiseFit,
        times_days: FloatArray,
        design: FloatArray,
        values_mm: FloatArray,
        memories_days: tuple[tuple[float, float], ...] = MEMORIES_DAYS,
    ) -> Mixture:
        """Try other noises than the best."""
        fits, shares = other_noises(fit, times_days, design, values_mm, memories_days)
        return cls(fits, shares, float(max(len(values_mm) - design.shape[1], 2)))

    def interval(self, combination: FloatArray, confidence: float) -> Interval:
        """Of a linear combination (p,) of the coefficients."""
        means = np.array([combination @ fit.coefficients for fit in self.fits])
        variances = [combination @ fit.covariance @ combination for fit in self.fits]
        return mixed(means, np.sqrt(variances), self.shares, self.degrees, confidence)


def mixed(
    means: FloatArray, sigmas: FloatArray, shares: FloatArray, degrees: float, confidence: float
) -> Interval:
    """Median, standard deviation and interval of a mixture of Student's t, all (k,)."""

    def quantile(probability: float) -> float:
        def beyond(value: float) -> float:
            return float(shares @ stdtr(degrees, (value - means) / sigmas)) - probability

        low, high = float((means - 60 * sigmas).min()), float((means + 60 * sigmas).max())
        return float(brentq(beyond, low, high))

    average = float(shares @ means)
    spread = float(np.sqrt(shares @ (sigmas**2 + (means - average) ** 2)))
    tail = 0.5 - 0.5 * confidence
    return Interval(quantile(0.5), spread, quantile(tail), quantile(1.0 - tail))


def by_blocks(
    times_days: FloatArray, design: FloatArray, fit: Gls, combination: FloatArray, confidence: float
) -> Interval | None:
    """Interval of a combination (p,) from how much it changes when each stretch is left out.

    Twenty stretches of equal length, fewer of a short record; None for less than eight. It needs
    no model of the noise within a stretch, and counts what the design does not follow (the
    delete-a-group jackknife; Cameron & Miller, J. Human Resources 50, 2015, CR3).
    """
    span_days = float(times_days[-1] - times_days[0])
    count = int(min(_BLOCKS, span_days / _BLOCK_DAYS))
    if count < _LEAST_BLOCKS:
        return None
    places = ((times_days - times_days[0]) / span_days * count).astype(np.int64)
    normal, changes = np.linalg.inv(fit.covariance), []
    scale = np.sqrt(np.diag(normal))
    for block in range(count):
        inside = np.minimum(places, count - 1) == block
        gone = design[inside].T @ fit.weighted_design[inside]
        score = design[inside].T @ fit.whitened[inside]
        left = (normal - 0.5 * (gone + gone.T)) / scale[:, None] / scale
        change = np.linalg.lstsq(left, score / scale, rcond=_NOT_THERE)[0] / scale
        changes.append(-combination @ change)
    value = float(combination @ fit.coefficients)
    sigma = float(np.sqrt((count - 1) / count * np.sum(np.square(changes))))
    half = sigma * float(stdtrit(count - 1, 0.5 + 0.5 * confidence))
    return Interval(value, sigma, value - half, value + half)


@dataclass(frozen=True, slots=True)
class Fit:
    """A design fitted to values."""

    keep: BoolArray
    """(n,) values that were used; the others are single bad ones."""
    noise_fit: NoiseFit

    @property
    def gls(self) -> Gls:
        """Coefficients and residuals, of the values that were used."""
        return self.noise_fit.gls

    @property
    def noise(self) -> Noise:
        """What is left."""
        return self.noise_fit.noise


def robust_fit(
    times_days: FloatArray,
    design: FloatArray,
    values_mm: FloatArray,
    memories_days: tuple[tuple[float, float], ...] = MEMORIES_DAYS,
) -> Fit:
    """Fit a design (n, p); values that disagree with both neighbours are left out."""
    keep = np.ones(len(values_mm), dtype=np.bool_)
    start = None
    for last in range(_PASSES):
        fit = fit_noise(times_days[keep], design[keep], values_mm[keep], memories_days, start)
        start = fit.start
        out = outliers(fit.whitening, fit.gls) if last < _PASSES - 1 else np.zeros(0, np.bool_)
        if not out.any():
            break
        keep[np.flatnonzero(keep)[out]] = False
    return Fit(keep, fit)


def outliers(whitening: Whitening, fit: Gls) -> BoolArray:
    """(n,) single values that neither the ones before nor the ones after explain.

    K^-1 r is the residual from all other values over its variance (Chen & Liu, J. Am. Stat. Assoc.
    88, 1993); a step that explains the values better than one bad value stays.
    """
    scale = _MAD_TO_SIGMA * float(np.median(np.abs(fit.whitened)))
    single = np.abs(fit.whitened) / max(scale, np.finfo(float).tiny)
    step = np.abs(step_scores(fit)) / np.sqrt(step_information(whitening, fit))
    neighbours = np.maximum(step, np.append(step[1:], 0.0))
    out: BoolArray = (single > _OUTLYING) & (single > neighbours)
    padded = np.pad(single, 1)
    out &= (single >= padded[:-2]) & (single >= padded[2:])  # a bad value shows in those beside it
    if out.sum() > _MOST_OUT * len(out):
        limit = np.quantile(single, 1.0 - _MOST_OUT)
        out &= single > limit
    return out


def step_scores(fit: Gls) -> FloatArray:
    """(n,) derivative of the log-likelihood by a step from each value on."""
    return np.cumsum(fit.whitened[::-1])[::-1]


_INFORMATION_GRID = 60
"""Places at which a step's information is computed; it is smooth in between."""
_INFORMATION_GAPS = 100
"""Of further places: at and beside the longest gaps, where it is another one."""
_GAP = 1.5
"""Usual distances between values from which a distance is a gap."""
_TAIL = 36
"""Last values at each of which it is computed: there it changes fast."""


def step_information(whitening: Whitening, fit: Gls) -> FloatArray:
    """(n,) inverse variance of a step's size from each value on, given the other coefficients."""
    n = len(fit.residuals)
    apart = np.diff(whitening.times_days)
    longest = np.argsort(-apart)[:_INFORMATION_GAPS]
    gaps = longest[apart[longest] > _GAP * np.median(apart)] + 1 if n > 1 else longest
    places = np.unique(
        np.concatenate(
            [
                np.linspace(0, n - 1, min(n, _INFORMATION_GRID)).astype(np.int64),
                *(np.clip(gaps + beside, 0, n - 1) for beside in (-1, 0, 1, 2, 4)),
                np.arange(max(0, n - _TAIL), n),
                np.arange(min(n, _TAIL)),
            ]
        )
    )
    row = np.arange(n)[:, None]
    blocks = (places[at : at + AT_ONCE] for at in range(0, len(places), AT_ONCE))
    squares = [whitening.squares((row >= block).astype(np.float64)) for block in blocks]
    own = np.concatenate(squares) / fit.variance_mm2
    shared = np.cumsum(fit.weighted_design[::-1], axis=0)[::-1]  # (n, p) design' K^-1 step
    taken = np.einsum("ij,jk,ik->i", shared, fit.covariance, shared)
    found = np.interp(np.arange(n), places, own)
    information: FloatArray = np.maximum(found - taken, 1e-9 * found)
    return information


def try_columns(
    whitening: Whitening, fit: Gls, columns: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Size (k,) and its inverse variance (k,) of each column (n, k), added alone to the design."""
    score = columns.T @ fit.whitened
    own = whitening.squares(columns) / fit.variance_mm2
    shared = fit.weighted_design.T @ columns
    taken = np.einsum("ik,ij,jk->k", shared, fit.covariance, shared)
    information = np.maximum(own - taken, 1e-9 * own)
    return score / information, information


def harmonics(times_s: FloatArray, period_days: float, numbers: tuple[int, ...]) -> FloatArray:
    """(n, 2 numbers) cosines and sines of a period."""
    angle = 2.0 * np.pi * times_s / DAY_S / period_days
    return np.column_stack([f(k * angle) for k in numbers for f in (np.cos, np.sin)])


def daily(times_s: FloatArray) -> FloatArray:
    """(n, 4) harmonics of the day; the same every day."""
    return harmonics(times_s, 1.0, _DAILY)


def yearly(times_s: FloatArray) -> FloatArray:
    """(n, 4) harmonics of the year; (n, 0) for a record that is too short."""
    if times_s[-1] - times_s[0] < LEAST_SEASON_DAYS * DAY_S:
        return np.empty((len(times_s), 0))
    return harmonics(times_s, YEAR_DAYS, _YEARLY)


def hinges(times_days: FloatArray, every_days: float) -> FloatArray:
    """(n, 1 + knots) a constant and a line that may bend at equal distances; inf: no line."""
    if np.isinf(every_days):
        return np.ones((len(times_days), 1))
    first, last = float(times_days[0]), float(times_days[-1])
    spans = max(1, round((last - first) / every_days))
    knots = np.linspace(first, last, spans + 1)[:-1]
    lines = np.maximum(times_days[:, None] - knots, 0.0)
    return np.column_stack([np.ones(len(times_days)), lines])


def independent(columns: FloatArray) -> FloatArray:
    """The columns (n, p) without those that others already contain.

    By a pivoted QR factorisation; which of two equal ones stays is the first.
    """
    kept: list[int] = []
    basis = np.empty((len(columns), 0))
    for place, column in enumerate(columns.T):
        left = column - basis @ (basis.T @ column)
        left -= basis @ (basis.T @ left)
        size = float(np.linalg.norm(left))
        if size > _ITS_OWN * max(float(np.linalg.norm(column)), np.finfo(float).tiny):
            kept.append(place)
            basis = np.column_stack([basis, left / size])
    return columns[:, kept]
