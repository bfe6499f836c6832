"""Compiled loop over guesses at a layout: which spots lie where each guess puts the discs."""

from __future__ import annotations

import math

import numpy as np

from core.arrays import FloatArray, IntArray
from core.compiled import compiled


@compiled
def nearest_spots(
    spots_px: FloatArray, log_sizes_px: FloatArray, anchors_px: FloatArray, anchors_mm: FloatArray,
    slopes: FloatArray, places_mm: FloatArray, log_radii_mm: FloatArray, size_tolerance: float,
    nearest: IntArray, away_mm: FloatArray,
) -> None:  # fmt: skip
    """For each map and each disc the nearest spot of about its size, and its distance, mm.

    spots_px (m, 2) with the logarithm of their radius (m,); maps by a point px (h, 2) at a place
    mm (h, 2) and a slope (h, 2, 2) px/mm; discs (n, 2) with the logarithm of their radius (n,).
    nearest (h, n) and away_mm (h, n) out; -1 and infinity where there is none.
    """
    x_mm, y_mm, log_mm = np.empty((3, len(spots_px)))
    for k in range(len(slopes)):
        a, b, c, d = slopes[k, 0, 0], slopes[k, 0, 1], slopes[k, 1, 0], slopes[k, 1, 1]
        det = a * d - b * c
        log_scale = 0.5 * math.log(abs(det))
        for spot in range(len(spots_px)):
            u = spots_px[spot, 0] - anchors_px[k, 0]
            v = spots_px[spot, 1] - anchors_px[k, 1]
            x_mm[spot] = (d * u - b * v) / det + anchors_mm[k, 0]
            y_mm[spot] = (a * v - c * u) / det + anchors_mm[k, 1]
            log_mm[spot] = log_sizes_px[spot] - log_scale
        for disc in range(len(places_mm)):
            best, choice = math.inf, -1
            for spot in range(len(spots_px)):
                x, y = x_mm[spot] - places_mm[disc, 0], y_mm[spot] - places_mm[disc, 1]
                square = x * x + y * y
                alike = abs(log_mm[spot] - log_radii_mm[disc]) < size_tolerance
                if alike and square < best:
                    best, choice = square, spot
            nearest[k, disc], away_mm[k, disc] = choice, math.sqrt(best)
