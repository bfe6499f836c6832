"""Compiled loop: how board coordinates run about each predicted corner of an image."""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.compiled import compiled
from core.grey_fit import solve_spd, substitute

TERMS = 5
"""u, v, u^2, u v, v^2."""


@compiled
def fit_maps(pixels: FloatArray, points: FloatArray, squares: FloatArray, maps: FloatArray) -> None:
    """Fit board coordinates as polynomials of a pixel's offset, by least squares.

    pixels (n, k, 2) px of k board points about each corner, which lie squares (k, 2) from it;
    points (n, 2) px of the corners. Out: maps (n, 2, 5) by (u, v, u^2, u v, v^2).
    """
    normal, row = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
    for n in range(len(points)):
        normal[:, :] = 0.0
        x, y = maps[n, 0], maps[n, 1]
        x[:], y[:] = 0.0, 0.0
        for k in range(len(squares)):
            u, v = pixels[n, k, 0] - points[n, 0], pixels[n, k, 1] - points[n, 1]
            row[0], row[1], row[2], row[3], row[4] = u, v, u * u, u * v, v * v
            for i in range(TERMS):
                x[i] += row[i] * squares[k, 0]
                y[i] += row[i] * squares[k, 1]
                for j in range(i + 1):
                    normal[i, j] += row[i] * row[j]
        if not solve_spd(normal, x, TERMS):
            x[:], y[:] = np.nan, np.nan
            continue
        substitute(normal, y, TERMS)
