"""What the fits to the grey values of corners and of discs share.

Gauss-Newton steps with analytic derivatives, and pixel weights that fade out what the model
cannot explain (dust, an insect). A saturated pixel is only known to be at least so bright: where
the model is brighter still it has no weight. The loops are compiled because NumPy
would write some twenty arrays of a million pixels for every step.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from core.arrays import BoolArray, FloatArray
from core.compiled import inner_loop
from core.images import GreyImage

MIN_PIXELS = 40
"""Fewer are not fitted: that is three to five for each of the models' 9 to 12 parameters."""
_FAR = 4.0
"""Blur widths from an edge beyond which it is flat, to 3e-5 of its contrast."""
_NODES_PER_WIDTH = 32.0
"""Of the table of the edge's profile: with cubic Hermite interpolation right to 1e-9."""
# The table: the profile erf(z / sqrt 2) and its derivative at z from -_FAR to beyond _FAR.
_NODES = np.arange(int(2 * _FAR * _NODES_PER_WIDTH) + 2) / _NODES_PER_WIDTH - _FAR
_PROFILE = erf(_NODES / math.sqrt(2.0))
_BELL = math.sqrt(2.0 / math.pi) * np.exp(-0.5 * _NODES**2)


def as_float(image: GreyImage) -> FloatArray:
    """Give the grey values as float32, DN."""
    return np.ascontiguousarray(image.pixels, dtype=np.float32)


_SINGULAR = 1e-12
"""A pivot that is a smaller share of its diagonal element is rounding: the matrix is singular."""
_FULL_WEIGHT_SIGMAS = 3.0
"""Up to here a pixel has full weight; 0.3 % of normal noise lies beyond."""
_ROUNDING_DN2 = 1.0 / 12.0
"""Variance of a grey value that was rounded to a whole number."""


@inner_loop
def solve_spd(matrix: FloatArray, vector: FloatArray, n: int) -> bool:
    """Solve in place by Cholesky; `vector` becomes the solution; False if not positive.

    >>> vector = np.array([8.0, 7.0])
    >>> solve_spd(np.array([[4.0, 2.0], [2.0, 3.0]]), vector, 2), vector.round(9).tolist()
    (True, [1.25, 1.5])
    """
    for j in range(n):
        total = matrix[j, j]
        for k in range(j):
            total -= matrix[j, k] * matrix[j, k]
        if not total > _SINGULAR * abs(matrix[j, j]) or total <= 0.0:
            return False
        pivot = math.sqrt(total)
        matrix[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / pivot
    substitute(matrix, vector, n)
    return True


@inner_loop
def solve_keeping(
    matrix: FloatArray, vector: FloatArray, factor: FloatArray, solution: FloatArray, n: int
) -> bool:
    """As `solve_spd`, but leave matrix and vector as they are: factor and solution are written.

    Element by element: for an assignment of arrays Numba compiles its message of unequal shapes
    too, which takes seconds.
    """
    for i in range(n):
        solution[i] = vector[i]
        for j in range(i + 1):
            factor[i, j] = matrix[i, j]
    return solve_spd(factor, solution, n)


@inner_loop
def substitute(factor: FloatArray, vector: FloatArray, n: int) -> None:
    """Solve in place with the Cholesky factor that `solve_spd` leaves."""
    for i in range(n):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * vector[k]
        vector[i] = total / factor[i, i]


@inner_loop
def edge(distance: float, blur: float) -> tuple[float, float, float]:
    """Edge profile erf(d / (sqrt 2 s)) and its derivatives by d and s.

    Between the nodes of a table by its own derivatives (cubic Hermite), right to 1e-9.

    >>> [round(value, 6) for value in edge(0.8, 0.8)]
    [0.682689, 0.604927, -0.604927]
    """
    z = distance / blur
    if z > _FAR:
        return 1.0, 0.0, 0.0
    if z < -_FAR:
        return -1.0, 0.0, 0.0
    at = (z + _FAR) * _NODES_PER_WIDTH
    node = int(at)
    t = at - node
    step = 1.0 / _NODES_PER_WIDTH
    here, there = _PROFILE[node], _PROFILE[node + 1]
    slope_here, slope_there = _BELL[node] * step, _BELL[node + 1] * step
    rise = there - here
    bend = 3.0 * rise - 2.0 * slope_here - slope_there
    twist = slope_here + slope_there - 2.0 * rise
    value = here + t * (slope_here + t * (bend + t * twist))
    bell = (slope_here + t * (2.0 * bend + 3.0 * t * twist)) * _NODES_PER_WIDTH / blur
    return value, bell, -bell * z


@inner_loop
def pixel_weight(miss: float, scale: float) -> float:
    """Full weight within 3 scale, beyond it that of Geman and McClure (1987); 1 when scale is 0."""
    if scale <= 0.0:
        return 1.0
    z = abs(miss) / (_FULL_WEIGHT_SIGMAS * scale)
    if z <= 1.0:
        return 1.0
    return 1.0 / (z * z * z * z)


@inner_loop
def reduce_to_shift(normal: FloatArray, information: FloatArray) -> bool:
    """Schur complement of the first two parameters in a lower normal matrix."""
    n = normal.shape[0]
    rest = np.zeros((n - 2, n - 2))
    for a in range(2, n):
        for b in range(2, a + 1):
            rest[a - 2, b - 2] = normal[a, b]
    information[0, 0], information[1, 0] = normal[0, 0], normal[1, 0]
    information[0, 1], information[1, 1] = normal[1, 0], normal[1, 1]
    for c in range(2):
        column = np.zeros(n - 2)
        for a in range(2, n):
            column[a - 2] = normal[a, c]
        factor = rest.copy()
        if not solve_spd(factor, column, n - 2):
            return False
        for d in range(2):
            for a in range(2, n):
                information[d, c] -= normal[a, d] * column[a - 2]
    return bool(information[0, 0] > 0.0 and information[1, 1] > 0.0)


def residual_noise(figures: FloatArray, parameters: int) -> FloatArray:
    """Root mean square residual per point, DN; rounding to whole values is in it, and its floor."""
    freedom = np.maximum(figures[:, 1] - parameters, 1.0)
    return np.sqrt(np.maximum(figures[:, 0] / freedom, _ROUNDING_DN2))


def covariances(information: FloatArray, noise: FloatArray, ok: BoolArray) -> FloatArray:
    """Covariances (n, 2, 2), px^2, of the usable ones; NaN for the others."""
    a, b, d = information[:, 0, 0], information[:, 0, 1], information[:, 1, 1]
    scale = noise**2 / np.where(ok, a * d - b * b, np.nan)
    covariance = np.empty((len(ok), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = scale * d, scale * a
    covariance[:, 0, 1] = covariance[:, 1, 0] = -scale * b
    return covariance
