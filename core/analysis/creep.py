"""Creep after loading: how well six laws explain the record, and what they predict together.

Each law is one or two curves f(t; shape) of the time t since loading, with a size each and one
zero: y = c + sum_k a_k f_k. All shapes within physical bounds are tried on a grid that closes in on
the likely ones, each with several noises that the record allows and several sizes of the concrete's
departure from the law (`creep_departure`); zero, sizes and what is regressed beside them are
integrated analytically, so that every combination has an evidence. A prediction is a mixture of
Student's t over all of them: its interval covers the choice of the law, of the noise and of the
departure (Hoeting et al., Statistical Science 14, 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from core.analysis.binning import HOUR_S, bins_of
from core.analysis.creep_departure import departure
from core.analysis.creep_fit import Curves, Record, Shapes, Weights, closed_in, weighed
from core.analysis.creep_laws import SHAPES, Law, curves
from core.analysis.noise import DAY_S, Noise, Part, fit_noise
from core.analysis.regression import Interval, daily, independent, mixed
from core.arrays import FloatArray

MEMORIES_DAYS = ((0.1, 2.0), (2.0, 30.0))
"""Bounds of the noise's memories."""
LEAST_DAYS = 10
"""Days after loading below which no law is fitted. Chosen."""
DEPARTURES = (0.0, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
"""Relative errors of the rate of creep (1 sigma): from none to one with which a law hardly says
anything."""
_EXACT = 0.5
"""Probability beforehand that a law holds exactly; the departures share the rest equally. Even
odds: neither is a bridge that follows a law an exception, nor one that follows none."""
_BEGIN_H = 2.0
"""Hours after loading that are left out: there a mean is not the curve at its time."""
_ROUNDS = 3
"""Of noise and best law in turn."""
_NOISE_SHARES = (0.2, 0.5, 1.0, 2.0)
"""Standard deviations of a slow part of the noise that are tried, over that of all noise."""
_NOISE_MEMORIES_DAYS = (2.0, 6.0, 18.0)
"""And its memories."""
_NOISE_UNLIKELY = 5.0
"""Fall of its log-evidence beyond which a noise is left out."""
_MIDDLING = (0.01, 0.08)
"""Departures beside which noises are judged."""
_UNLIKELY = 7.0
"""Fall of the log-evidence beyond which a law with a departure is not tried with other noises."""
_FORGOTTEN = 1e-5
"""Share of the best combination's probability below which one is left out."""


@dataclass(frozen=True, slots=True)
class LawFit:
    """How one law explains the record, at its best shape."""

    law: Law
    shape: dict[str, float]
    sizes_mm: tuple[float, ...]
    """Creep from loading to the end of the record, of each of its curves."""
    aicc: float
    """Akaike's criterion, corrected for few values; the least is the best, 2 is a difference."""
    probability: float
    """Of the law, all equally likely beforehand, over all its shapes."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """The level at a time since loading, temperature at its mean over the hours since loading."""

    days: float
    mm: Interval
    """`value` is the median."""


@dataclass(frozen=True, slots=True)
class Creep:
    """What the laws say."""

    laws: tuple[LawFit, ...]
    """The most probable first."""
    predictions: tuple[Prediction, ...]
    values: int
    """Means that were fitted: of hours at first, then of days."""
    sigma_mm: float
    """Of such a mean about the best law."""
    departure: float
    """Relative error of the laws' rate that the record shows (1 sigma, median)."""


def fit_creep(
    times_s: FloatArray,
    values_mm: FloatArray,
    loaded_s: float,
    at_days: Sequence[float],
    beside: FloatArray | None = None,
    *,
    confidence: float = 0.9,
) -> Creep:
    """Fit the laws to values (n,) since loading, and predict. Further columns (n, k) lie beside.

    Values before `loaded_s` are not used. Raises ValueError for too few days.
    """
    record = _reduced(times_s, values_mm, loaded_s, np.array(at_days, dtype=np.float64), beside)
    days, lines = record.days, record.design
    best = curves(Law.LOGARITHMIC, days, np.ones((1, 1)))[0]
    start = None
    for _ in range(_ROUNDS):
        fit = fit_noise(
            days,
            np.column_stack([lines, best]),
            record.level_mm,
            MEMORIES_DAYS,
            start,
            record.weights,
        )
        start = fit.start
        weights = Weights.of(record, _covariance(record, fit.noise))
        exact = {law: closed_in(law, weights)[1] for law in Law}
        law = max(exact, key=lambda law: float(exact[law].log_likelihood.max()))
        best = curves(law, days, exact[law].best_shape[None])[0]
    noises = _likely_noises(record, fit.noise, exact[law])
    blocks = _departing(exact, record, noises)
    total = logsumexp(np.concatenate([block.log_evidence for block in blocks]))
    shares = dict.fromkeys(Law, 0.0)
    for block in blocks:
        shares[block.law] += float(np.exp(block.log_evidence - total).sum())
    fits = [_law_fit(law, exact[law], shares[law], record) for law in Law]
    return Creep(
        tuple(sorted(fits, key=lambda one: -one.probability)),
        _predictions(record, blocks, confidence),
        len(days),
        fit.noise.sigma_mm,
        _median_departure(blocks, float(total)),
    )


def _reduced(
    times_s: FloatArray,
    values_mm: FloatArray,
    loaded_s: float,
    at_days: FloatArray,
    beside: FloatArray | None,
) -> Record:
    """Means since loading, and the design beside the law: constant, day, columns.

    Of hours, quarters of days, then days: never long against the time since loading.
    """
    since = times_s >= loaded_s + _BEGIN_H * HOUR_S
    times_s, values_mm = times_s[since], values_mm[since]
    if not len(times_s) or times_s[-1] - loaded_s < LEAST_DAYS * DAY_S:
        msg = f"less than {LEAST_DAYS} days after loading: too short for a law of creep"
        raise ValueError(msg)
    edges_days = np.concatenate(
        [
            np.arange(_BEGIN_H / 24.0, 2.0, 1.0 / 24.0),
            np.arange(2.0, 8.0, 0.25),
            np.arange(8.0, (times_s[-1] - loaded_s) / DAY_S + 1.0),
        ]
    )
    edges_s = loaded_s + edges_days * DAY_S
    means = [bins_of(times_s, column, edges_s) for column in (times_s, values_mm)]
    filled = means[0].count > 0
    if int(filled.sum()) < LEAST_DAYS:
        msg = f"less than {LEAST_DAYS} days with a value after loading"
        raise ValueError(msg)
    days = (means[0].mean[filled] - loaded_s) / DAY_S
    further = daily(times_s) if beside is None else np.column_stack([daily(times_s), beside[since]])
    further = further - further.mean(axis=0)  # of hours: the first days have more of the means
    columns = np.array([bins_of(times_s, column, edges_s).mean[filled] for column in further.T]).T
    design = np.column_stack([np.ones(len(days)), columns])
    count = means[1].count[filled]
    weights = count / np.median(count)
    return Record(days, means[1].mean[filled], independent(design), at_days, weights)


def _covariance(record: Record, noise: Noise) -> FloatArray:
    """(n, n) in mm2."""
    apart = np.abs(np.subtract.outer(record.days, record.days))
    found = np.diag(noise.white_mm**2 / record.weights)
    for part in noise.parts:
        found += part.sigma_mm**2 * np.exp(-apart / part.memory_days)
    return found


def _noises(noise: Noise) -> list[Noise]:
    """The noise that fits best, and others with another slow part.

    Equally likely beforehand.
    """
    others = [
        Noise(noise.white_mm, (noise.parts[0], Part(share * noise.sigma_mm, memory)))
        for share in _NOISE_SHARES
        for memory in _NOISE_MEMORIES_DAYS
    ]
    return [noise, *others]


def _likely_noises(record: Record, noise: Noise, best: Shapes) -> list[FloatArray]:
    """Covariances (n, n) of the noises that the record allows, the best first.

    A record of a few memories does not determine the slow part: what it may be belongs in the
    interval. Judged beside the best law with a middling departure; equally likely beforehand.
    """
    departs = departure(best.course_mm(float(record.days[-1])), record.days, record.at_days)
    shape = best.best_shape[None]
    curve = Curves.of(best.law, shape, record, 0.0)
    found = [_covariance(record, one) for one in _noises(noise)]
    logs = (
        np.array(
            [
                float(weighed(curve, Weights.of(record, one, departs, size), size).log_evidence[0])
                for one in found
                for size in _MIDDLING
            ]
        )
        .reshape(-1, len(_MIDDLING))
        .max(axis=1)
    )
    order = np.argsort(-logs)
    return [found[number] for number in order if logs[number] > logs.max() - _NOISE_UNLIKELY]


def _departing(
    exact: dict[Law, Shapes], record: Record, noises: Sequence[FloatArray]
) -> list[Shapes]:
    """The laws with each departure and noise; the other noises where the first is likely."""
    first = []
    for law, fit in exact.items():
        departs = departure(fit.course_mm(float(record.days[-1])), record.days, record.at_days)
        for size in DEPARTURES:
            beforehand = _EXACT if size == 0.0 else (1.0 - _EXACT) / (len(DEPARTURES) - 1)
            near, best = closed_in(law, Weights.of(record, noises[0], departs, size), size)
            first.append((near, best.likelier(beforehand), departs, beforehand))
    logs = [float(logsumexp(best.log_evidence)) for _, best, _, _ in first]
    blocks = [best for _, best, _, _ in first]
    for (near, best, departs, beforehand), log in zip(first, logs, strict=True):
        if log > max(logs) - _UNLIKELY:
            for noise in noises[1:]:
                weights = Weights.of(record, noise, departs, best.departure)
                blocks.append(weighed(near, weights, best.departure).likelier(beforehand))
    return blocks


def _law_fit(law: Law, exact: Shapes, probability: float, record: Record) -> LawFit:
    best = int(np.argmax(exact.log_likelihood))
    n, sizes = len(record.days), exact.size_mm[best]
    k = record.design.shape[1] + len(sizes) + len(exact.best_shape) + _NOISE_PARAMETERS
    aicc = n * np.log(exact.residual[best] / n) + 2.0 * k + 2.0 * k * (k + 1) / max(n - k - 1, 1)
    names = [parameter.name for parameter in SHAPES[law]]
    shape = dict(zip(names, map(float, exact.best_shape), strict=True))
    return LawFit(law, shape, tuple(map(float, sizes)), float(aicc), probability)


_NOISE_PARAMETERS = 5
"""Standard deviations and memories: equal for all laws."""


def _predictions(
    record: Record, blocks: Sequence[Shapes], confidence: float
) -> tuple[Prediction, ...]:
    """The mixture over all combinations at each time."""
    logs = np.concatenate([block.log_evidence for block in blocks])
    weights = np.exp(logs - logs.max())
    kept = weights > _FORGOTTEN
    weights = weights[kept] / weights[kept].sum()
    means = np.vstack([block.mean_mm for block in blocks])[kept]
    sigmas = np.vstack([block.sigma_mm for block in blocks])[kept]
    degrees = float(len(record.days) - record.design.shape[1] - 1)
    return tuple(
        Prediction(float(at), mixed(mean, sigma, weights, degrees, confidence))
        for at, mean, sigma in zip(record.at_days, means.T, sigmas.T, strict=True)
    )


def _median_departure(blocks: Sequence[Shapes], total: float) -> float:
    shares = np.zeros(len(DEPARTURES))
    for block in blocks:
        shares[DEPARTURES.index(block.departure)] += np.exp(block.log_evidence - total).sum()
    return DEPARTURES[int(np.searchsorted(np.cumsum(shares), 0.5 * shares.sum()))]
