"""How far the concrete departs from a law of creep: a random process, for no law is exact.

The rate of creep differs from the law's by a relative error that changes smoothly with the
logarithm of time: a Gaussian process of standard deviation s. What it adds to the creep is then one
too, with a covariance that follows from the law's curve. Fitted beside a law, it keeps a wrong law
from being certain: a law's own size and shape hold no error that all its curves share (Kennedy &
O'Hagan, J. R. Stat. Soc. B 63, 2001).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray

_FIRST_DAYS = 0.01
"""Creep before it is one error. Chosen: the record begins later."""
_CELL = 0.25
"""Of the logarithm of time, in which the error is constant."""
MEMORY = 1.5
"""Of the error, in the logarithm of time: nothing in creep changes faster than one Kelvin element,
whose rate by the logarithm of time, x exp(-x), is as wide as a Gaussian of sigma 1.04; white noise
smoothed by it has the covariance exp(-(d / 1.5)^2 / 2)."""


CourseMm = Callable[[FloatArray], FloatArray]
"""A law's creep (n,) at times (n,) after loading."""


@dataclass(frozen=True, slots=True)
class Departure:
    """What a relative error of 1 of the rate adds to the creep, as covariances in mm2."""

    within: FloatArray
    """(n, n) of the record's values."""
    between: FloatArray
    """(n, m) of them and the values asked for."""
    asked: FloatArray
    """(m,) variances of the values asked for."""


def departure(course_mm: CourseMm, days: FloatArray, at_days: FloatArray) -> Departure:
    """Of a law's creep, for the times of a record `days` (n,) and others `at_days` (m,)."""
    times = np.concatenate([days, at_days])
    last = float(np.log(times.max() / _FIRST_DAYS))
    edges = _FIRST_DAYS * np.exp(_CELL * np.arange(np.ceil(last / _CELL) + 1.0))
    edges[0] = 0.0
    until = np.minimum(times[:, None], edges[1:])
    grown = course_mm(np.maximum(until, edges[:-1]).ravel()).reshape(until.shape)
    grown = grown - course_mm(edges[:-1])
    apart = _CELL * np.subtract.outer(np.arange(len(edges) - 1), np.arange(len(edges) - 1))
    covariance = grown @ np.exp(-0.5 * (apart / MEMORY) ** 2) @ grown.T
    n = len(days)
    return Departure(covariance[:n, :n], covariance[:n, n:], np.diag(covariance)[n:].copy())
