"""The shapes of a law of creep beside a record, weighted by noise and departure: their evidence.

Everything that is linear, zero, what lies beside the law and the sizes of its curves, is integrated
analytically; so are noise and departure, by the Cholesky factor of their covariance. What the
record tells of a later time is the best linear prediction (kriging with a trend).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import starmap

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from core.analysis.creep_departure import CourseMm, Departure
from core.analysis.creep_laws import SHAPES, Law, curves
from core.arrays import BoolArray, FloatArray

_SIZE_PRIOR = 3.0
"""Prior standard deviation of the creep within the record, in ranges of the record. Broad on
purpose: it only makes the laws comparable."""
_POINTS = {1: 41, 2: 15}
"""Of the grid along each shape parameter, by their number."""
_ZOOMS = 5
"""How often the grid closes in; most often it stands still before."""
_STILL = 0.5
"""Share of the box that is left where the grid has closed in enough."""
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
    """(n, p) beside the law; the first column is the constant, the others have no mean."""
    at_days: FloatArray
    """(m,)."""


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
        told = weighted[:, 1 : 1 + m]
        left = np.maximum(asked - np.einsum("nm,nm->m", told, told), 0.0)
        return cls(record, half, basis, corner, weighted[:, 0], told, left)

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
    """(k, curves) creep from loading to the record's end."""
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

    @property
    def best_shape(self) -> FloatArray:
        """(parameters,) of the greatest likelihood."""
        found: FloatArray = self.shapes[int(np.argmax(self.log_likelihood))]
        return found

    def course_mm(self, end_days: float) -> CourseMm:
        """The creep since loading at the best shape."""
        shape, size_mm = self.best_shape, self.size_mm[int(np.argmax(self.log_likelihood))]
        ends = curves(self.law, np.array([end_days]), shape)[0]
        return lambda days: curves(self.law, days, shape) @ (size_mm / ends)


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
    log_prior: float
    """Of each shape."""

    @classmethod
    def of(cls, law: Law, shapes: FloatArray, record: Record, log_prior: float) -> Curves:
        """For the times of the record, and those asked for."""
        times, n = np.concatenate([record.days, record.at_days]), len(record.days)
        found = np.array([curves(law, times, shape) for shape in shapes])
        found /= found[:, n - 1 : n]
        return cls(law, shapes, found[:, :n], found[:, n:], log_prior)

    def only(self, which: BoolArray) -> Curves:
        """Some of them (k,)."""
        chosen = self.shapes[which], self.within[which], self.asked[which]
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
    tried = tried.only(likely)
    return tried, weighed(tried, weights, size)


def _middles(low: float, high: float, number: int) -> FloatArray:
    return low + (np.arange(number) + 0.5) * (high - low) / number


def weighed(tried: Curves, weights: Weights, size: float) -> Shapes:
    """Shapes (k,) beside the design, their evidence and what they predict."""
    record, (n, p) = weights.record, weights.record.design.shape
    k, _, q = tried.within.shape
    columns = tried.within.transpose(1, 0, 2).reshape(n, k * q)
    whole = solve_triangular(weights.half, columns, lower=True)
    shared = weights.basis.T @ whole
    curve = (whole - weights.basis @ shared).reshape(n, k, q)
    level = weights.level - weights.basis @ (weights.basis.T @ weights.level)
    information = np.einsum("nkq,nkr->kqr", curve, curve)
    score = np.einsum("nkq,n->kq", curve, level)
    trace = np.trace(information, axis1=1, axis2=2)
    inverse = np.linalg.inv(information + 1e-9 * trace[:, None, None] * np.eye(q))
    size_mm = np.einsum("kqr,kr->kq", inverse, score)
    total, tiny = float(level @ level), np.finfo(float).tiny
    residual = np.maximum(total - np.einsum("kq,kq->k", score, size_mm), tiny)
    prior = (_SIZE_PRIOR * float(np.ptp(record.level_mm))) ** -2 * np.eye(q)
    shrunk = np.einsum("kqr,kr->kq", np.linalg.inv(information + prior), score)
    left = np.maximum(total - np.einsum("kq,kq->k", score, shrunk), residual)
    _, log_widths = np.linalg.slogdet((information + prior) / prior[0, 0])
    # What the times asked for owe to the departure, the design and the curves, in this order.
    first = np.eye(p)[:, :1] - weights.corner.T @ (weights.basis.T @ weights.asked)  # (p, m)
    lever = solve_triangular(weights.corner, first, trans="T")
    taken = (weights.asked.T @ whole + lever.T @ shared).reshape(-1, k, q)
    asked = tried.asked - taken.swapaxes(0, 1)
    told = (weights.asked + weights.basis @ lever).T @ weights.level
    variance = weights.asked_variance + np.einsum("pm,pm->m", lever, lever)
    variance = variance + np.einsum("kmq,kqr,kmr->km", asked, inverse, asked)
    return Shapes(
        law=tried.law,
        shapes=tried.shapes,
        size_mm=size_mm,
        residual=residual,
        log_likelihood=-0.5 * (n - p) * np.log(residual),
        log_evidence=-0.5 * (n - p) * np.log(left)
        - 0.5 * log_widths
        + weights.log_determinant
        + tried.log_prior,
        mean_mm=told + np.einsum("kmq,kq->km", asked, size_mm),
        sigma_mm=np.sqrt(residual[:, None] / (n - p - q) * variance),
        departure=size,
    )
