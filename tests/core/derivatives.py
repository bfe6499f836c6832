"""Derivatives by finite differences, to hold the analytic ones against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from core.arrays import FloatArray


def by_differences(function: Callable[[FloatArray], FloatArray], steps: FloatArray) -> FloatArray:
    """d(function)/d(parameters) at 0 by central differences; the parameter is the last axis."""
    columns = []
    for k, step in enumerate(steps):
        delta = np.zeros(len(steps))
        delta[k] = step
        columns.append((function(delta) - function(-delta)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def assert_same_derivative(analytic: FloatArray, numeric: FloatArray) -> None:
    """Agree to 1e-6 of each column's largest entry."""
    assert analytic.shape == numeric.shape
    largest = np.abs(numeric).max(axis=tuple(range(numeric.ndim - 1)))
    assert np.all(np.abs(analytic - numeric) <= 1e-6 * largest + 1e-10)
