"""Compiled loops over a board's corners: the normal equations of its pose."""

from __future__ import annotations

import math

from core.arrays import FloatArray
from core.compiled import compiled


@compiled
def whiten_residuals(
    residual: FloatArray, whiten: FloatArray, white: FloatArray, norm: FloatArray
) -> None:
    """Fill white (n, 2) = whiten (n, 2, 2) residual (n, 2), and its norms (n,)."""
    for n in range(len(residual)):
        u, v = residual[n, 0], residual[n, 1]
        x = whiten[n, 0, 0] * u + whiten[n, 0, 1] * v
        y = whiten[n, 1, 0] * u + whiten[n, 1, 1] * v
        white[n, 0], white[n, 1] = x, y
        norm[n] = math.sqrt(x * x + y * y)


@compiled
def pose_normal(
    rotated: FloatArray,
    by_point: FloatArray,
    whiten: FloatArray,
    white: FloatArray,
    weights: FloatArray,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Fill the normal matrix (6, 6) and right side (6,) of a small step of the pose.

    rotated (n, 3) = R X; by_point (n, 2, 3) d(px)/d(point). A turn by delta moves a point by
    delta x (R X), so d(px)/d(delta) is (R X) x d(px)/d(point).
    """
    row = [0.0] * 6
    normal[:, :] = 0.0
    right[:] = 0.0
    for n in range(len(rotated)):
        x, y, z = rotated[n, 0], rotated[n, 1], rotated[n, 2]
        for k in range(2):
            a = whiten[n, k, 0] * by_point[n, 0, 0] + whiten[n, k, 1] * by_point[n, 1, 0]
            b = whiten[n, k, 0] * by_point[n, 0, 1] + whiten[n, k, 1] * by_point[n, 1, 1]
            c = whiten[n, k, 0] * by_point[n, 0, 2] + whiten[n, k, 1] * by_point[n, 1, 2]
            row[0], row[1], row[2] = y * c - z * b, z * a - x * c, x * b - y * a
            row[3], row[4], row[5] = a, b, c
            for i in range(6):
                scaled = weights[n] * row[i]
                right[i] += scaled * white[n, k]
                for j in range(i + 1):
                    normal[i, j] += scaled * row[j]
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
