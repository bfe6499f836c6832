"""The shapes of a law of creep beside a record, weighted by noise and departure: their evidence.

Everything that is linear, zero, what lies beside the law and the sizes of its curves, is integrated
analytically; so are noise and departure, by the Cholesky factor of their covariance. What the
record tells of a later time is the best linear prediction (kriging with a trend).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import starmap

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr, ndtri

from core.analysis.creep_departure import CourseMm, Departure
from core.analysis.creep_laws import SHAPES, Law, curves
from core.arrays import BoolArray, FloatArray

_SIZE_PRIOR = 3.0
"""Prior standard deviation of a size, in ranges of the record: broad on purpose. The size is that
within the record; of a Kelvin element the final one, equally likely for all times (a spectrum as
even as that of logarithmic creep: Bazant & Xi, J. Eng. Mech. 121, 1995)."""
_POINTS = {1: 41, 2: 15}
"""Of the grid along each shape parameter, by their number."""
_ZOOMS = 5
"""How often the grid closes in; most often it stands still before."""
_STILL = 0.5
"""Share of the box that is left where the grid has closed in enough."""
_NUMBER = 89
"""Places at which a normal distribution of two sizes is looked at. Chosen: their share to 1 %."""
_TURN = 55
"""Fibonacci's number before it, which spreads them evenly."""
_PLACES = ndtri(
    np.column_stack([(np.arange(_NUMBER) + 0.5), (np.arange(_NUMBER) * _TURN + 0.5) % _NUMBER])
    / _NUMBER
)
"""(89, 2) even places of two independent standard normal variables: a Fibonacci lattice."""
_SQUARES = (_PLACES[:, :, None] * _PLACES[:, None]).reshape(_NUMBER, 4)
"""(89, 4) their products."""
_UNLIKELY = 12.0
"""Fall of the log-likelihood beyond which a shape does not matter: a factor of 160,000."""


@dataclass(frozen=True, slots=True)
class Record:
    """What is fitted, and when the level is asked for."""

    days: FloatArray
    """(n,)."""
    level_mm: FloatArray
    """(n,)."""
    design: FloatArray
    """(n, p) beside the law; the first column is the constant, the level asked for less creep."""
    at_days: FloatArray
    """(m,)."""
    weights: FloatArray
    """(n,) hours that a mean is of, over the median."""


@dataclass(frozen=True, slots=True)
class Weights:
    """The record weighted by a covariance, everything beside the law fitted."""

    record: Record
    half: FloatArray
    """(n, n) lower triangular Cholesky factor of the covariance."""
    basis: FloatArray
    """(n, p) orthonormal, of the weighted design."""
    corner: FloatArray
    """(p, p) upper triangular, of the weighted design."""
    level: FloatArray
    """(n,) weighted."""
    asked: FloatArray
    """(n, m) weighted covariance with the departure at the times asked for."""
    asked_variance: FloatArray
    """(m,) of the departure there, as far as the record does not tell it."""

    @classmethod
    def of(
        cls,
        record: Record,
        covariance: FloatArray,
        departs: Departure | None = None,
        size: float = 0.0,
    ) -> Weights:
        """By the noise's covariance (n, n), with a departure of a relative error or without."""
        n, m = len(record.days), len(record.at_days)
        between: FloatArray = np.zeros((n, m))
        asked: FloatArray = np.zeros(m)
        if departs is not None:
            covariance = covariance + size**2 * departs.within
            between, asked = size**2 * departs.between, size**2 * departs.asked
        half = cholesky(covariance, lower=True)
        columns = np.column_stack([record.level_mm, between, record.design])
        weighted = solve_triangular(half, columns, lower=True)
        basis, corner = np.linalg.qr(weighted[:, 1 + m :])
        explained = weighted[:, 1 : 1 + m]
        left = np.maximum(asked - np.einsum("nm,nm->m", explained, explained), 0.0)
        return cls(record, half, basis, corner, weighted[:, 0], explained, left)

    @property
    def log_determinant(self) -> float:
        """Of what is integrated: noise, departure and the design's coefficients."""
        corner = np.abs(np.diag(self.corner))
        return float(-np.log(np.diag(self.half)).sum() - np.log(corner).sum())


@dataclass(frozen=True, slots=True)
class Shapes:
    """Shapes (k,) of one law with one noise and one departure."""

    law: Law
    shapes: FloatArray
    """(k, parameters)."""
    size_mm: FloatArray
    """(k, curves) creep from loading to the record's end, all of one sign."""
    residual: FloatArray
    """(k,) weighted sum of squares left."""
    log_likelihood: FloatArray
    """(k,)."""
    log_evidence: FloatArray
    """(k,)."""
    mean_mm: FloatArray
    """(k, m) at the times asked for."""
    sigma_mm: FloatArray
    """(k, m)."""
    departure: float

    def likelier(self, beforehand: float) -> Shapes:
        """With a further probability beforehand."""
        return replace(self, log_evidence=self.log_evidence + float(np.log(beforehand)))

    def only(self, which: BoolArray) -> Shapes:
        """Some of them (k,)."""
        return replace(
            self,
            shapes=self.shapes[which],
            size_mm=self.size_mm[which],
            residual=self.residual[which],
            log_likelihood=self.log_likelihood[which],
            log_evidence=self.log_evidence[which],
            mean_mm=self.mean_mm[which],
            sigma_mm=self.sigma_mm[which],
        )

    @property
    def best_shape(self) -> FloatArray:
        """(parameters,) of the greatest likelihood."""
        found: FloatArray = self.shapes[int(np.argmax(self.log_likelihood))]
        return found

    def course_mm(self, end_days: float) -> CourseMm:
        """The creep since loading at the best shape."""
        shape, size_mm = self.best_shape, self.size_mm[int(np.argmax(self.log_likelihood))]
        ends = curves(self.law, np.array([end_days]), shape[None])[0, 0]
        return lambda days: curves(self.law, days, shape[None])[0] @ (size_mm / ends)


@dataclass(frozen=True, slots=True)
class Curves:
    """The curves of shapes (k,) of one law, each 1 at the record's end."""

    law: Law
    shapes: FloatArray
    """(k, parameters)."""
    within: FloatArray
    """(k, n, curves)."""
    asked: FloatArray
    """(k, m, curves)."""
    grown: FloatArray
    """(k, curves) share of what a curve's size is judged by that is there at the record's end."""
    log_prior: float
    """Of each shape."""

    @classmethod
    def of(cls, law: Law, shapes: FloatArray, record: Record, log_prior: float) -> Curves:
        """For the times of the record, and those asked for."""
        times, n = np.concatenate([record.days, record.at_days]), len(record.days)
        found = curves(law, times, shapes)
        ends = found[:, n - 1 : n].copy()
        grown = ends[:, 0] if law is Law.DOUBLE_EXPONENTIAL else np.ones_like(ends[:, 0])
        found /= ends
        return cls(law, shapes, found[:, :n], found[:, n:], grown, log_prior)

    def only(self, which: BoolArray) -> Curves:
        """Some of them (k,)."""
        chosen = self.shapes[which], self.within[which], self.asked[which], self.grown[which]
        return Curves(self.law, *chosen, self.log_prior)


def closed_in(law: Law, weights: Weights, size: float = 0.0) -> tuple[Curves, Shapes]:
    """The shapes of a law that matter, on a grid that closes in on them."""
    parameters = SHAPES[law]
    points = _POINTS[len(parameters)]
    low, high = np.zeros(len(parameters)), np.ones(len(parameters))
    for _ in range(_ZOOMS):
        axes = list(starmap(_middles, zip(low, high, [points] * len(low), strict=True)))
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(low))
        shapes = np.column_stack(
            [one.at(place) for one, place in zip(parameters, places.T, strict=True)]
        )
        log_prior = float(np.log(np.prod(high - low) / len(places)))
        tried = Curves.of(law, shapes, weights.record, log_prior)
        found = weighed(tried, weights, size)
        likely = found.log_likelihood > found.log_likelihood.max() - _UNLIKELY
        step = (high - low) / points
        closer = (
            np.maximum(places[likely].min(axis=0) - step, 0.0),
            np.minimum(places[likely].max(axis=0) + step, 1.0),
        )
        if np.prod(closer[1] - closer[0]) > _STILL * np.prod(high - low):
            break
        low, high = closer
    return tried.only(likely), found.only(likely)


def _middles(low: float, high: float, number: int) -> FloatArray:
    return low + (np.arange(number) + 0.5) * (high - low) / number


def weighed(tried: Curves, weights: Weights, size: float) -> Shapes:
    """Shapes (k,) beside the design, their evidence and what they predict.

    Of a law of two curves both sizes have one sign: what loads a bridge moves it one way.
    """
    record, (n, p) = weights.record, weights.record.design.shape
    k, _, q = tried.within.shape
    columns = tried.within.transpose(1, 0, 2).reshape(n, k * q)
    whole = solve_triangular(weights.half, columns, lower=True)
    shared = weights.basis.T @ whole
    curve = whole - weights.basis @ shared
    level = weights.level - weights.basis @ (weights.basis.T @ weights.level)
    score = (level @ curve).reshape(k, q)
    by_shape = np.ascontiguousarray(curve.T).reshape(k, q, n)
    information = by_shape @ by_shape.swapaxes(1, 2)
    trace = np.trace(information, axis1=1, axis2=2)
    inverse = np.linalg.inv(information + 1e-9 * trace[:, None, None] * np.eye(q))
    free_mm = np.einsum("kqr,kr->kq", inverse, score)
    total, tiny = float(level @ level), np.finfo(float).tiny
    free = np.maximum(total - np.einsum("kq,kq->k", score, free_mm), tiny)
    size_mm, lost, _ = _most_likely_one_way(free_mm, inverse)
    residual = free + lost
    prior_mm = _SIZE_PRIOR * float(np.ptp(record.level_mm)) * tried.grown  # (k, q)
    inverse = np.linalg.inv(information + prior_mm[:, :, None] ** -2 * np.eye(q))
    shrunk_mm = np.einsum("kqr,kr->kq", inverse, score)
    left = np.maximum(total - np.einsum("kq,kq->k", score, shrunk_mm), free)
    log_width = np.log(prior_mm).sum(axis=1) - 0.5 * np.linalg.slogdet(inverse)[1]
    scale = free / (n - p - q)
    one_way = _one_way(shrunk_mm, scale[:, None, None] * inverse)
    # What the times asked for owe to the departure, the design and the curves, in this order.
    first = np.eye(p)[:, :1] - weights.corner.T @ (weights.basis.T @ weights.asked)  # (p, m)
    lever = solve_triangular(weights.corner, first, trans="T")
    taken = (weights.asked.T @ whole + lever.T @ shared).reshape(-1, k, q)
    asked = tried.asked - taken.swapaxes(0, 1)
    departed_mm = (weights.asked + weights.basis @ lever).T @ weights.level
    variance = weights.asked_variance + np.einsum("pm,pm->m", lever, lever)
    variance = scale[:, None] * variance
    variance = variance + np.einsum("kmq,kqr,kmr->km", asked, one_way.covariance_mm2, asked)
    return Shapes(
        law=tried.law,
        shapes=tried.shapes,
        size_mm=size_mm,
        residual=residual,
        log_likelihood=-0.5 * (n - p) * np.log(residual),
        log_evidence=-0.5 * (n - p) * np.log(left)
        - log_width
        + one_way.log_gain
        + weights.log_determinant
        + tried.log_prior,
        mean_mm=departed_mm + np.einsum("kmq,kq->km", asked, one_way.mean_mm),
        sigma_mm=np.sqrt(variance),
        departure=size,
    )


@dataclass(frozen=True, slots=True)
class _OneWay:
    """Normally distributed sizes (k, q) of which those are kept that have one sign."""

    log_gain: FloatArray
    """(k,) logarithm of their share over that beforehand."""
    mean_mm: FloatArray
    """(k, q)."""
    covariance_mm2: FloatArray
    """(k, q, q)."""


def _one_way(size_mm: FloatArray, covariance_mm2: FloatArray) -> _OneWay:
    """By even places of the normal distribution; all sizes (k, 1) have one sign.

    Where no place has, by the tail of the size that is nearest to none.
    """
    if size_mm.shape[1] == 1:
        return _OneWay(np.zeros(len(size_mm)), size_mm, covariance_mm2)
    half = np.linalg.cholesky(covariance_mm2)
    sizes = size_mm[:, :, None] + half @ _PLACES.T
    same = (sizes[:, 0] * sizes[:, 1] > 0.0).astype(np.float64)
    number = same.sum(axis=1)
    share = same / np.maximum(number, 1.0)[:, None]
    mean = share @ _PLACES
    second = (share @ _SQUARES).reshape(-1, 2, 2) - mean[:, :, None] * mean[:, None]
    mean_mm = size_mm + (half @ mean[:, :, None])[:, :, 0]
    edge_mm, squares, edge_mm2 = _most_likely_one_way(size_mm, covariance_mm2)
    there, log_tail = number > 0.0, log_ndtr(-np.sqrt(squares))
    return _OneWay(
        np.where(there, np.log(np.maximum(number, 1.0) / _NUMBER), log_tail) - np.log(0.5),
        np.where(there[:, None], mean_mm, edge_mm),
        np.where(there[:, None, None], half @ second @ half.swapaxes(1, 2), edge_mm2),
    )


def _most_likely_one_way(
    size_mm: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The most likely sizes (k, q) of one sign, their squared distance (k,), their covariance.

    Where both signs would be best one of the curves has no part.
    """
    if size_mm.shape[1] == 1:
        return size_mm, np.zeros(len(size_mm)), covariance
    own = np.diagonal(covariance, axis1=1, axis2=2)
    squares = size_mm**2 / own
    gone, every = np.argmin(squares, axis=1), np.arange(len(size_mm))
    gain = covariance[every, :, gone] / own[every, gone][:, None]  # (k, q)
    one_mm = size_mm - gain * size_mm[every, gone][:, None]
    one_mm2 = covariance - gain[:, :, None] * covariance[every, gone][:, None]
    both = size_mm[:, 0] * size_mm[:, 1] > 0.0
    return (
        np.where(both[:, None], size_mm, one_mm),
        np.where(both, 0.0, squares[every, gone]),
        np.where(both[:, None, None], covariance, one_mm2),
    )
