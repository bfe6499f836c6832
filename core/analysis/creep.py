"""Creep after loading: how well five laws explain the record, and what they predict together.

Each law is one or two curves f(t; shape) of the time t since loading, with a size each and one
zero: y = c + sum_k a_k f_k. All shapes within physical bounds are tried on a grid that closes in on
the likely ones; zero, sizes and what is regressed beside them are integrated analytically, so that
every shape of every law has an evidence. A prediction is a mixture of Student's t over all of them:
its interval covers the choice of the law (Hoeting et al., Statistical Science 14, 1999).

Sources of the curves: EN 1992-1-1:2004 (B.7); ACI 209R-92, section 2.4; Bazant & Osman, Cem. Concr.
Res. 6 (1976) for the power law; Kelvin chain of two elements for the double exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import starmap

import numpy as np
from scipy.special import logsumexp

from core.analysis.binning import HOUR_S, bins_of
from core.analysis.noise import DAY_S, Gls, NoiseFit, Whitening, fit_noise, gls, other_noises
from core.analysis.regression import Interval, daily, independent, mixed
from core.arrays import FloatArray, IntArray

MEMORIES_DAYS = ((0.1, 2.0), (2.0, 30.0))
"""Bounds of the noise's memories."""
LEAST_DAYS = 10
"""Days after loading below which no law is fitted. Chosen."""
_BEGIN_H = 2.0
"""Hours after loading that are left out: there a mean is not the curve at its time."""
_SIZE_PRIOR = 3.0
"""Prior standard deviation of the creep within the record, in ranges of the record. Broad on
purpose: it only makes the laws comparable."""
_CODE_EXPONENT = 0.3
"""Of EN 1992-1-1 (B.7)."""
_POINTS = {1: 61, 2: 25}
"""Of the grid along each shape parameter, by their number."""
_ZOOMS = 5
"""How often the grid closes in; most often it stands still before."""
_UNLIKELY = 12.0
"""Fall of the log-likelihood beyond which a shape does not matter: a factor of 160,000."""
_ROUNDS = 3
"""Of noise and best law in turn."""


class Law(StrEnum):
    """The usual laws of creep."""

    LOGARITHMIC = "logarithmic"
    POWER = "power"
    DOUBLE_EXPONENTIAL = "double-exponential"
    EUROCODE = "eurocode2"
    ACI = "aci209"


@dataclass(frozen=True, slots=True)
class ShapeParameter:
    """What bends a law's curve, equally likely between its bounds beforehand."""

    name: str
    low: float
    high: float
    by_ratio: bool = False
    """Equally likely by its logarithm."""

    def at(self, place: FloatArray) -> FloatArray:
        """Its values (n,) at places from 0 to 1."""
        if self.by_ratio:
            return self.low * (self.high / self.low) ** place
        return self.low + (self.high - self.low) * place


SHAPES: dict[Law, tuple[ShapeParameter, ...]] = {
    Law.LOGARITHMIC: (ShapeParameter("time_days", 0.1, 100.0, by_ratio=True),),
    Law.POWER: (ShapeParameter("exponent", 0.03, 1.0),),
    Law.DOUBLE_EXPONENTIAL: (
        ShapeParameter("fast_days", 0.5, 40.0, by_ratio=True),
        ShapeParameter("slow_days", 40.0, 2000.0, by_ratio=True),
    ),
    Law.EUROCODE: (ShapeParameter("beta_h_days", 250.0, 1500.0),),  # (B.8): up to 1500
    Law.ACI: (
        ShapeParameter("exponent", 0.4, 0.8),
        ShapeParameter("time", 6.0, 30.0),  # the bounds that ACI 209 names
    ),
}
"""By law; the bounds are physical ones."""


def curves(law: Law, days: FloatArray, shape: FloatArray) -> FloatArray:
    """(n, curves) course of a law `days` (n,) after loading; 0 before.

    >>> curves(Law.POWER, np.array([0.0, 100.0]), np.array([0.5])).ravel().tolist()
    [0.0, 10.0]
    """
    since = np.maximum(days, 0.0)[:, None]
    found: FloatArray
    match law:
        case Law.LOGARITHMIC:
            found = np.log1p(since / shape)
        case Law.POWER:
            found = since**shape
        case Law.EUROCODE:
            found = (since / (shape + since)) ** _CODE_EXPONENT
        case Law.ACI:
            found = since ** shape[0] / (shape[1] + since ** shape[0])
        case Law.DOUBLE_EXPONENTIAL:
            found = -np.expm1(-since / shape)
    return found


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
    """The level at a time since loading, temperature at its mean."""

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
    days, level_mm, design = _reduced(times_s, values_mm, loaded_s, beside)
    best = curves(Law.LOGARITHMIC, days, np.ones(1))
    start = None
    for _ in range(_ROUNDS):
        whole = np.column_stack([design, best])
        fit = fit_noise(days, whole, level_mm, MEMORIES_DAYS, start)
        start = fit.start
        beside_all = _Beside.of(fit, design, days, level_mm)
        tried = [_tried(law, beside_all) for law in Law]
        best = max(
            (one for law in tried for one in law), key=lambda one: one.log_likelihood
        ).columns
    wider = _Wider.of(fit, days, whole, level_mm)
    every = [one for law in tried for one in law]
    logs = np.array([one.log_evidence for one in every])
    weights = np.exp(logs - logsumexp(logs))
    laws = [_law_fit(law, every, weights, beside_all) for law in Law]
    return Creep(
        tuple(sorted(laws, key=lambda one: -one.probability)),
        tuple(_predicted(at, beside_all, every, weights, wider, confidence) for at in at_days),
        len(days),
        fit.noise.sigma_mm,
    )


def _reduced(
    times_s: FloatArray, values_mm: FloatArray, loaded_s: float, beside: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Days since loading, means, and the design beside the law: constant, day, columns.

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
    columns = np.array([bins_of(times_s, column, edges_s).mean[filled] for column in further.T]).T
    design = np.column_stack([np.ones(len(days)), columns - columns.mean(axis=0)])
    return days, means[1].mean[filled], independent(design)


@dataclass(frozen=True, slots=True)
class _Beside:
    """The record with all but the law fitted, and the noise's correlation."""

    days: FloatArray
    level_mm: FloatArray
    whitening: Whitening
    base: Gls
    total: float
    """Weighted sum of squares without a law."""
    variance: float
    """Weighted variance with the best law so far."""

    @classmethod
    def of(
        cls, fit: NoiseFit, design: FloatArray, days: FloatArray, level_mm: FloatArray
    ) -> _Beside:
        base = gls(fit.whitening, design, level_mm)
        total = base.variance_mm2 * (len(days) - design.shape[1])
        return cls(days, level_mm, fit.whitening, base, total, fit.gls.variance_mm2)


@dataclass(frozen=True, slots=True)
class _Wider:
    """By what other noises than the best, which the record allows too, make a law less certain."""

    factors: FloatArray
    """(k,) on the standard deviation."""
    shares: FloatArray
    """(k,)."""

    @classmethod
    def of(cls, fit: NoiseFit, days: FloatArray, whole: FloatArray, level_mm: FloatArray) -> _Wider:
        fits, shares = other_noises(fit, days, whole, level_mm, MEMORIES_DAYS)
        variances = np.array([one.covariance[-1, -1] for one in fits])
        return cls(np.sqrt(variances / fit.gls.covariance[-1, -1]), shares)


@dataclass(frozen=True, slots=True)
class _Tried:
    """One shape of one law."""

    law: Law
    shape: FloatArray
    columns: FloatArray
    """(n, curves), each 1 at the record's end."""
    end: FloatArray
    """(curves,) by which they were divided."""
    size_mm: FloatArray
    """(curves,)."""
    inverse: FloatArray
    """(curves, curves) covariance of the sizes for a weighted variance of 1."""
    projection: FloatArray
    """(curves,) of the curves on the constant."""
    residual: float
    """Weighted sum of squares left."""
    log_likelihood: float
    log_evidence: float
    """Its share of the law's evidence."""


def _tried(law: Law, beside: _Beside) -> list[_Tried]:
    """The shapes of a law that matter, on a grid that closes in on them."""
    parameters = SHAPES[law]
    low, high = np.zeros(len(parameters)), np.ones(len(parameters))
    for _ in range(_ZOOMS):
        axes = list(starmap(_middles, zip(low, high, [_POINTS[len(low)]] * len(low), strict=True)))
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(low))
        cell = float(np.prod(high - low)) / len(places)
        shapes = np.column_stack(
            [one.at(place) for one, place in zip(parameters, places.T, strict=True)]
        )
        found = _evidences(law, shapes, beside)
        likely = found.log_likelihood > found.log_likelihood.max() - _UNLIKELY
        step = (high - low) / _POINTS[len(low)]
        closer = (
            np.maximum(places[likely].min(axis=0) - step, 0.0),
            np.minimum(places[likely].max(axis=0) + step, 1.0),
        )
        if np.prod(closer[1] - closer[0]) > _STILL * np.prod(high - low):
            break
        low, high = closer
    return found.tried(law, shapes, np.flatnonzero(likely), float(np.log(cell)))


_STILL = 0.5
"""Share of the box that is left where the grid has closed in enough."""


def _middles(low: float, high: float, number: int) -> FloatArray:
    return low + (np.arange(number) + 0.5) * (high - low) / number


@dataclass(frozen=True, slots=True)
class _Evidences:
    """Many shapes (k,) of one law."""

    columns: FloatArray
    """(n, k, curves)."""
    ends: FloatArray
    """(k, curves)."""
    size_mm: FloatArray
    """(k, curves)."""
    inverse: FloatArray
    """(k, curves, curves)."""
    projection: FloatArray
    """(k, curves)."""
    residual: FloatArray
    """(k,)."""
    log_likelihood: FloatArray
    """(k,)."""
    log_evidence: FloatArray
    """(k,) but for the prior of the shape."""

    def tried(
        self, law: Law, shapes: FloatArray, which: IntArray, log_prior: float
    ) -> list[_Tried]:
        """Some of them, each by itself."""
        return [
            _Tried(
                law,
                shapes[k],
                self.columns[:, k],
                self.ends[k],
                self.size_mm[k],
                self.inverse[k],
                self.projection[k],
                float(self.residual[k]),
                float(self.log_likelihood[k]),
                float(self.log_evidence[k] + log_prior),
            )
            for k in which
        ]


def _evidences(law: Law, shapes: FloatArray, beside: _Beside) -> _Evidences:
    """Each shape (k, parameters) beside the design."""
    base, n = beside.base, len(beside.days)
    degrees = n - len(base.coefficients)
    prior = beside.variance / (_SIZE_PRIOR * float(np.ptp(beside.level_mm))) ** 2
    ends = np.array([curves(law, beside.days[-1:], shape)[0] for shape in shapes])
    columns = np.array([curves(law, beside.days, shape) for shape in shapes]) / ends[:, None]
    columns = columns.transpose(1, 0, 2)
    k, q = ends.shape
    solved = beside.whitening.solve(columns.reshape(n, k * q)).reshape(n, k, q)
    shared = np.einsum("np,nkq->kpq", base.weighted_design, columns) * base.variance_mm2
    projections = base.covariance / base.variance_mm2 @ shared
    information = np.einsum("nkq,nkr->kqr", columns, solved)
    information -= np.einsum("kpq,kpr->kqr", shared, projections)
    score = np.einsum("nkq,n->kq", columns, base.whitened) * base.variance_mm2
    trace = np.trace(information, axis1=1, axis2=2)
    inverse = np.linalg.inv(information + 1e-9 * trace[:, None, None] * np.eye(q))
    size_mm = np.einsum("kqr,kr->kq", inverse, score)
    tiny = np.finfo(float).tiny
    residual = np.maximum(beside.total - np.einsum("kq,kq->k", score, size_mm), tiny)
    with_prior = information + prior * np.eye(q)
    shrunk = np.einsum("kqr,kr->kq", np.linalg.inv(with_prior), score)
    left = np.maximum(beside.total - np.einsum("kq,kq->k", score, shrunk), residual)
    _, log_widths = np.linalg.slogdet(with_prior / prior)
    return _Evidences(
        columns,
        ends,
        size_mm,
        inverse,
        projections[:, 0],
        residual,
        -0.5 * degrees * np.log(residual),
        -0.5 * degrees * np.log(left) - 0.5 * log_widths,
    )


def _law_fit(law: Law, every: list[_Tried], weights: FloatArray, beside: _Beside) -> LawFit:
    own = [number for number, one in enumerate(every) if one.law is law]
    best = max((every[number] for number in own), key=lambda one: one.log_likelihood)
    n = len(beside.days)
    k = len(beside.base.coefficients) + len(best.size_mm) + len(best.shape) + _NOISE_PARAMETERS
    aicc = n * np.log(best.residual / n) + 2.0 * k + 2.0 * k * (k + 1) / max(n - k - 1, 1)
    names = [parameter.name for parameter in SHAPES[law]]
    shape = dict(zip(names, map(float, best.shape), strict=True))
    probability = float(weights[own].sum())
    return LawFit(law, shape, tuple(map(float, best.size_mm)), float(aicc), probability)


_NOISE_PARAMETERS = 5
"""Standard deviations and memories: equal for all laws."""


def _predicted(
    days: float,
    beside: _Beside,
    every: list[_Tried],
    weights: FloatArray,
    wider: _Wider,
    confidence: float,
) -> Prediction:
    """The mixture over all shapes at one time."""
    base = beside.base
    at = np.array([days])
    levers = [curves(one.law, at, one.shape)[0] / one.end - one.projection for one in every]
    mean = base.coefficients[0] + np.array(
        [one.size_mm @ lever for one, lever in zip(every, levers, strict=True)]
    )
    zero = base.covariance[0, 0] / base.variance_mm2
    sigma = np.sqrt(
        [
            one.residual
            / (len(beside.days) - len(base.coefficients) - len(one.size_mm))
            * (zero + lever @ one.inverse @ lever)
            for one, lever in zip(every, levers, strict=True)
        ]
    )
    means, sigmas = np.tile(mean, len(wider.factors)), np.outer(wider.factors, sigma).ravel()
    shares = np.outer(wider.shares, weights).ravel()
    degrees = float(len(beside.days) - len(base.coefficients) - 1)
    return Prediction(days, mixed(means, sigmas, shares, degrees, confidence))
