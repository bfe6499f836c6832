"""Steps in a record: when, how big, how sure; and whether it has drifted in the last months.

For each time at which a step may have happened its size over its standard deviation is found, in a
model with the temperature, the day, a slowly bending line and noise that remembers (Tsay, J.
Forecasting 7, 1988; Chen & Liu, J. Am. Stat. Assoc. 88, 1993). The greatest is accepted if noise
alone would hardly show it in years; then the noise is fitted again and the next is looked for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from core.analysis.noise import DAY_S, Noise, NoiseFit, fit_noise, gls
from core.analysis.regression import (
    YEAR_DAYS,
    Interval,
    Mixture,
    daily,
    hinges,
    independent,
    outliers,
    step_information,
    step_scores,
)
from core.arrays import BoolArray, FloatArray

THRESHOLD = 4.5
"""Standard deviations of a step's size at which it is one. Of 8766 hours' independent normal values
one exceeds it in 17 years; the benchmark `analysis` counts."""
DRIFT_THRESHOLD = 3.0
"""Standard deviations of the last months' slope at which it is a drift. Tried daily, slopes of 90
days are some 20 independent ones a year, of which one exceeds it in 18 years. At 3.5, which would
be one in 100 years, a seventh of the drifts of 0.5 mm a year were missed."""
_DRIFT_CONFIDENCE = float(1.0 - 2.0 * ndtr(-DRIFT_THRESHOLD))
"""The interval that must not hold 0."""
DRIFT_DAYS = 90.0
"""What a drift is looked for in."""
BEND_DAYS = 45.0
"""The line under the steps may bend at this distance: creep is no row of steps."""
_EDGE = 8
"""Values before and after a step without which there is none."""
_MOST_STEPS = 40
"""In one record."""
_ROUNDS = 3
"""Searches for single bad values between two steps."""
_MAD_TO_SIGMA = 1.4826
"""As in `binning`."""
_WHEN_DROP = 3.84
"""Fall of twice the log-likelihood that ends the 95 % interval of a time."""


@dataclass(frozen=True, slots=True)
class Step:
    """A lasting change of level."""

    first_s: float
    """Earliest time, 95 %."""
    time_s: float
    """Time of the first value after it."""
    last_s: float
    """Latest time, 95 %."""
    mm: Interval
    score: float
    """Size over its standard deviation, under the noise as it was when it was found."""


@dataclass(frozen=True, slots=True)
class Steps:
    """The steps of a record, and what could have been found."""

    steps: tuple[Step, ...]
    noise: Noise
    keep: BoolArray
    """(n,) without single bad values."""
    columns: FloatArray
    """(n, steps) 0 before and 1 after each."""
    highest_score: float
    """Of what is left: how near it comes to the threshold."""
    smallest_mm: float
    """Step that is found in nine of ten cases, in the middle of the record."""
    smallest_in_a_day_mm: float
    """Step that is found in nine of ten cases from the values of 24 hours after it."""


def find_steps(
    times_s: FloatArray,
    values_mm: FloatArray,
    beside: FloatArray | None = None,
    *,
    threshold: float = THRESHOLD,
    confidence: float = 0.95,
    with_days: bool = True,
    bend_days: float = BEND_DAYS,
) -> Steps:
    """Find the steps of values (n,) at increasing times, with columns (n, k) beside them."""
    times_days = (times_s - times_s[0]) / DAY_S
    columns = [hinges(times_days, bend_days)]
    if with_days:
        columns.append(daily(times_s))
    if beside is not None:
        columns.append(beside - beside.mean(axis=0))
    background = independent(np.column_stack(columns))
    search = _Search(times_s, times_days, values_mm, background)
    found: list[tuple[int, float, int, int]] = []
    while len(found) < _MOST_STEPS:
        best = search.best([place for place, *_ in found])
        if abs(best[1]) < threshold:
            break
        place, score, first, last = best
        score /= search.spread([*(other for other, *_ in found), place])
        if abs(score) < threshold:
            break
        found.append((place, score, first, last))
    found = search.confirmed(found, threshold)
    return search.judged(sorted(found), confidence, threshold)


class _Search:
    """Values, what is fitted beside the steps, and the noise as it is known so far."""

    def __init__(
        self,
        times_s: FloatArray,
        times_days: FloatArray,
        values_mm: FloatArray,
        background: FloatArray,
    ) -> None:
        self._times_s, self._times_days = times_s, times_days
        self._values_mm, self._background = values_mm, background
        self._keep = np.ones(len(times_s), dtype=np.bool_)
        self._start: FloatArray | None = None
        self._fit: NoiseFit | None = None

    def columns(self, places: list[int]) -> FloatArray:
        """(n, steps)."""
        return (np.arange(len(self._times_s))[:, None] >= np.array(places, int)).astype(np.float64)

    def best(self, places: list[int]) -> tuple[int, float, int, int]:
        """Place, score, first and last possible place of the step that explains most."""
        for _ in range(_ROUNDS):
            fit = self.fitted(places)
            out = outliers(fit.whitening, fit.gls)
            if not out.any():
                break
            self._keep[np.flatnonzero(self._keep)[out]] = False
        else:
            fit = self.fitted(places)
        score = self._scores(fit, places)
        kept = np.flatnonzero(self._keep)
        at = int(np.argmax(np.abs(score)))
        near = np.flatnonzero(score**2 < score[at] ** 2 - _WHEN_DROP)
        first = near[near < at].max(initial=-1) + 1
        last = near[near > at].min(initial=len(score)) - 1
        return int(kept[at]), float(score[at]), int(kept[first]), int(kept[last])

    def _scores(self, fit: NoiseFit, places: list[int]) -> FloatArray:
        """Of a further step at each value that is kept, beside those at places."""
        score = step_scores(fit.gls) / np.sqrt(step_information(fit.whitening, fit.gls))
        score[:_EDGE] = score[-_EDGE + 1 :] = 0.0
        # A second one at a place would be rounding over rounding.
        score[np.searchsorted(np.flatnonzero(self._keep), places)] = 0.0
        return score

    def spread(self, places: list[int]) -> float:
        """By what the scores beside steps exceed what the noise lets expect: 1, or more.

        Where the noise is not what can be fitted, the scores' own spread says so.
        """
        inner = self._scores(self.fitted(places), places)[_EDGE : -_EDGE + 1]
        return max(1.0, _MAD_TO_SIGMA * float(np.median(np.abs(inner))))

    def fitted(self, places: list[int]) -> NoiseFit:
        """Noise and coefficients with steps at places."""
        keep = self._keep
        design = np.column_stack([self._background, self.columns(places)])[keep]
        fit = fit_noise(self._times_days[keep], design, self._values_mm[keep], start=self._start)
        self._start = fit.start
        return fit

    def confirmed(
        self, found: list[tuple[int, float, int, int]], threshold: float
    ) -> list[tuple[int, float, int, int]]:
        """Those that stand beside all others; the weakest of the others is dropped first."""
        found = list(found)
        while found:
            fit = self.fitted([place for place, *_ in found])
            count = len(found)
            sigma = np.sqrt(np.diag(fit.gls.covariance))[-count:]
            scores = np.abs(fit.gls.coefficients[-count:]) / sigma
            scores /= self.spread([place for place, *_ in found])
            weakest = int(np.argmin(scores))
            if scores[weakest] >= threshold:
                break
            del found[weakest]
        return found

    def judged(
        self, found: list[tuple[int, float, int, int]], confidence: float, threshold: float
    ) -> Steps:
        """Sizes with intervals, and what could have been found."""
        places = [place for place, *_ in found]
        fit = self.fitted(places)
        parameters = len(fit.gls.coefficients)
        keep = self._keep
        design = np.column_stack([self._background, self.columns(places)])[keep]
        mixture = Mixture.of(fit, self._times_days[keep], design, self._values_mm[keep])
        steps = []
        for number, (place, score, first, last) in enumerate(found):
            row = parameters - len(found) + number
            mm = mixture.interval(np.eye(parameters)[row], confidence)
            before_s = float(self._times_s[max(first - 1, 0)])
            steps.append(
                Step(before_s, float(self._times_s[place]), float(self._times_s[last]), mm, score)
            )
        without = gls(
            fit.whitening, self._background[self._keep], self._values_mm[self._keep]
        )  # where a step is already, another would not be seen
        without = replace(
            without,
            covariance=without.covariance * fit.gls.variance_mm2 / without.variance_mm2,
            weighted_design=without.weighted_design * without.variance_mm2 / fit.gls.variance_mm2,
            variance_mm2=fit.gls.variance_mm2,
        )
        step_sigma = 1.0 / np.sqrt(step_information(fit.whitening, without))
        needed = threshold + float(ndtri(0.9))
        kept_s = self._times_s[self._keep]
        day = int(np.searchsorted(kept_s, kept_s[-1] - DAY_S))
        return Steps(
            tuple(steps),
            fit.noise,
            self._keep,
            self.columns(places),
            float(np.abs(self._scores(fit, places)).max(initial=0.0)),
            needed * float(step_sigma[len(step_sigma) // 2]),
            needed * float(step_sigma[day]),
        )


@dataclass(frozen=True, slots=True)
class Drift:
    """The slope of the last months."""

    mm_per_year: Interval
    score: float
    days: float
    """That it was fitted to."""

    @property
    def significant(self) -> bool:
        """Whether noise alone would hardly show it."""
        return abs(self.score) >= DRIFT_THRESHOLD


def recent_drift(
    times_s: FloatArray,
    values_mm: FloatArray,
    beside: FloatArray | None = None,
    *,
    days: float = DRIFT_DAYS,
    confidence: float = 0.95,
    with_days: bool = True,
) -> Drift:
    """Slope over the last days, with everything before them, free to bend, for the noise.

    `beside` (n, k) are temperature and known steps.
    """
    times_days = (times_s - times_s[-1]) / DAY_S
    earlier = max(1, round((-times_days[0] - days) / days))
    knots = np.unique(np.append(np.linspace(times_days[0], -days, earlier + 1), -days))
    knots = knots[(knots >= times_days[0]) & (knots < 0.0)]
    if not len(knots) or knots[0] > times_days[0]:
        knots = np.append(times_days[0], knots)
    knots = knots[-1:] if -times_days[0] <= 1.2 * days else knots
    lines = np.maximum(times_days[:, None] - knots, 0.0) / YEAR_DAYS
    columns = [np.ones((len(times_s), 1)), lines]
    if with_days:
        columns.append(daily(times_s))
    if beside is not None:
        columns.append(beside - beside.mean(axis=0))
    from_first = np.column_stack(columns)
    fit = fit_noise(times_days, from_first, values_mm)
    combination = np.zeros(from_first.shape[1])
    combination[1 : 1 + len(knots)] = 1.0  # the last slope is the sum of all bends
    mixture = Mixture.of(fit, times_days, from_first, values_mm)
    found = mixture.interval(combination, confidence)
    narrow = mixture.interval(combination, _DRIFT_CONFIDENCE)
    edge = narrow.low if found.value > 0.0 else narrow.high
    normal = DRIFT_THRESHOLD * found.value / max(abs(found.value - edge), np.finfo(float).tiny)
    return Drift(found, normal, min(days, -float(times_days[0])))
