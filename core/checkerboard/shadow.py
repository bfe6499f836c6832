"""Where a shadow's edge crosses the board: corners under it are lost, and nothing else is."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from core.arrays import BoolArray, FloatArray

_REACH_SQUARES = 3.2
"""Radius in which a lost corner's neighbours are looked at. Chosen: a penumbra covers one or two
squares, and beyond it there must be neighbours on both sides."""
_LEAST_NEIGHBOURS = 8
"""Fewer do not show two sides."""
_STEP, _LIGHT_STEP = 1.15, 1.1
"""Ratio of the contrast, and of the light, on the two sides of a shadow's edge, at least. Chosen:
sun to shade is a factor of two and more; lamps and lenses change by less over so few squares."""
_SHARES = 15.0, 85.0
"""Percentiles of the neighbours' contrast that stand for the two sides: some may be odd."""


def crossed_by_shadow(
    points_px: FloatArray, seen_px: FloatArray, white_dn: FloatArray, black_dn: FloatArray
) -> BoolArray:
    """Whether the light steps at points (k, 2) where corners should be and are not clear.

    seen_px (m, 2) are the corners that are, white_dn and black_dn (m,) the squares about them.
    By a shadow's edge some of a point's neighbours are lit and others not; what lies on the
    board leaves those beside it as they are, and glare adds to black what it adds to white.

    >>> seen_px = np.array([[20.0 * i, 20.0 * j] for i in range(5) for j in range(5) if i != 2])
    >>> lit = seen_px[:, 0] > 40.0  # the sun to the right, the edge of a shadow along i = 2
    >>> crossed_by_shadow(
    ...     np.array([[40.0, 40.0]]), seen_px, np.where(lit, 200.0, 90.0), np.where(lit, 20.0, 9.0)
    ... ).tolist()
    [True]
    """
    crossed = np.zeros(len(points_px), dtype=bool)
    if len(points_px) == 0 or len(seen_px) < _LEAST_NEIGHBOURS:
        return crossed
    seen = cKDTree(seen_px)
    next_px = np.asarray(seen.query(seen_px, k=[2])[0])
    reach_px = _REACH_SQUARES * float(np.median(next_px))
    for k in range(len(points_px)):
        near = np.asarray(seen.query_ball_point(points_px[k], reach_px), dtype=int)
        if len(near) >= _LEAST_NEIGHBOURS:
            crossed[k] = _steps(white_dn[near], black_dn[near])
    return crossed


def _steps(white_dn: FloatArray, black_dn: FloatArray) -> bool:
    """Whether some corners have more contrast than others, and more light with it."""
    contrast, light = white_dn - black_dn, 0.5 * (white_dn + black_dn)
    low, high = np.percentile(contrast, _SHARES)
    if not high > _STEP * max(low, 0.0):
        return False
    lit = contrast > np.sqrt(max(low, 0.0) * high)
    return bool(np.median(light[lit]) > _LIGHT_STEP * np.median(light[~lit]))
