"""Homographies of a plane with circles on it: fit, slopes, and where circles' centres are seen."""

from __future__ import annotations

import numpy as np

from core.site import FloatArray

_PERSPECTIVE_SIGMA = 0.2  # change of scale over the target's size, before looking
_SLOPE_SIGMA = 0.15


def fit_homography(
    places_mm: FloatArray, points_px: FloatArray, sigma_px: float, slope: FloatArray
) -> FloatArray:
    """Homography H (3, 3), `[u v 1]' ~ H [x y 1]'`, of points (n, 2) on a plane.

    slope (2, 2), px/mm, is what its derivative is about, right to 15 %, and perspective is small
    before the points say otherwise, so that three points or more on a line make it well-defined.
    """
    middle, origin = places_mm.mean(axis=0), points_px.mean(axis=0)
    size = max(float(np.ptp(places_mm, axis=0).max()), 1e-9)
    places, points = (places_mm - middle) / size, points_px - origin
    n = len(places)
    prior = slope * size
    extent = float(np.abs(prior).max())
    # (A p + t) / (1 + h p) = x is linear in A, t and h but for the weight 1 / (1 + h p).
    design, right = np.zeros((2 * n + 6, 8)), np.zeros(2 * n + 6)
    weight = np.full(n, 1.0 / sigma_px)
    solution: FloatArray = np.zeros(8)
    for k in range(4):
        design[2 * n + k, k] = 1.0 / (_SLOPE_SIGMA * extent)
        right[2 * n + k] = prior.ravel()[k] * design[2 * n + k, k]
    design[-2, 6] = design[-1, 7] = 1.0 / _PERSPECTIVE_SIGMA
    for _ in range(2):
        for k in range(2):
            rows = slice(k, 2 * n, 2)
            design[rows, 2 * k : 2 * k + 2] = places * weight[:, None]
            design[rows, 4 + k] = weight
            design[rows, 6:] = -points[:, k, None] * places * weight[:, None]
            right[rows] = points[:, k] * weight
        solution = np.linalg.lstsq(design, right, rcond=None)[0]
        weight = 1.0 / (sigma_px * np.maximum(1.0 + places @ solution[6:], 0.1))
    a, b, c, d, e, f, g, h = solution
    normalised = np.array([[a, b, e], [c, d, f], [g, h, 1.0]])
    to_places = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, size]])
    to_points = np.array([[1.0, 0.0, origin[0]], [0.0, 1.0, origin[1]], [0.0, 0.0, 1.0]])
    H: FloatArray = to_points @ normalised @ to_places
    return np.asarray(H / H[2, 2])


def project(H: FloatArray, places_mm: FloatArray) -> FloatArray:
    """Images (n, 2), px, of points (n, 2) on the plane."""
    seen = places_mm @ H[:, :2].T + H[:, 2]
    return np.asarray(seen[:, :2] / seen[:, 2:])


def slopes(H: FloatArray, places_mm: FloatArray) -> FloatArray:
    """Derivatives (n, 2, 2) of the image by the place, px/mm."""
    depth = places_mm @ H[2, :2] + H[2, 2]
    seen = project(H, places_mm)
    return np.asarray((H[None, :2, :2] - seen[:, :, None] * H[2, :2]) / depth[:, None, None])


def perspective(H: FloatArray, places_mm: FloatArray) -> float:
    """By how much the depth changes over the places, relative to its mean."""
    depth = places_mm @ H[2, :2] + H[2, 2]
    return float(np.ptp(depth) / np.abs(depth.mean()))


def outline_offset(H: FloatArray, places_mm: FloatArray, radii_mm: FloatArray) -> FloatArray:
    """Middle of each circle's outline less the image of its centre, (n, 2) px.

    The dual conic of the circle, `C = c c' - r^2 diag(1, 1, 0)` with `c = [x y 1]'`, is seen as
    `H C H'`; its last column is the middle of the ellipse (Hartley and Zisserman, 2.2.3, 3.2).
    """
    seen = places_mm @ H[:, :2].T + H[:, 2]
    plane = H[:, :2] @ H[2, :2]
    squared = radii_mm[:, None] ** 2
    column = seen * seen[:, 2:] - squared * plane
    return np.asarray(column[:, :2] / column[:, 2:] - seen[:, :2] / seen[:, 2:])
