"""Homographies of a plane with circles on it: fit, slopes, and where circles' centres are seen."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from core.arrays import FloatArray

_PERSPECTIVE_SIGMA = 0.2
"""1-sigma prior of the change of scale over the target's size. Chosen wide: a plate of 100 mm seen
from 11 m, tilted by 30 degrees, changes by 0.005."""
_SLOPE_SIGMA = 0.15
"""1-sigma prior of the homography's derivative, relative to the one given. Chosen: the
derivative comes from the outlines of blobs, and decides only what points on a line leave
open."""
_OUTLINE_SHARE, _OUTLINE_SIGMA_PX = 0.03, 0.2
"""1 sigma of an outline's half axes: a share of them, and px. Chosen large, so
that the discs' middles decide wherever they can."""
_LEAST_DEPTH = 0.1
"""Of the depth at the target's middle: weights of points are limited there before the second
step."""
_SIZE_FLOOR_MM = 1e-9
"""So that a target of one point does not divide by zero."""


def fit_homography(
    places_mm: FloatArray, points_px: FloatArray, sigma_px: float, slope: FloatArray
) -> FloatArray:
    """Homography H (3, 3), `[u v 1]' ~ H [x y 1]'`, of points (n, 2) on a plane.

    slope (2, 2), px/mm, is what its derivative is about, right to 15 %, and perspective is small
    unless the points say otherwise, so that three points or more on a line make it well-defined.
    """
    middle, origin = places_mm.mean(axis=0), points_px.mean(axis=0)
    size = max(float(np.ptp(places_mm, axis=0).max()), _SIZE_FLOOR_MM)
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
        weight = 1.0 / (sigma_px * np.maximum(1.0 + places @ solution[6:], _LEAST_DEPTH))
    a, b, c, d, e, f, g, h = solution
    normalised = np.array([[a, b, e], [c, d, f], [g, h, 1.0]])
    to_places = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, size]])
    to_points = np.array([[1.0, 0.0, origin[0]], [0.0, 1.0, origin[1]], [0.0, 0.0, 1.0]])
    H: FloatArray = to_points @ normalised @ to_places
    return np.asarray(H / H[2, 2])


def refine_on_circles(
    H: FloatArray,
    places_mm: FloatArray,
    radii_mm: FloatArray,
    middles_px: FloatArray,
    outlines_px: FloatArray,
    sigma_px: float,
) -> FloatArray:
    """Homography that fits the seen outlines of circles (n,) best, from a first one.

    middles_px (n, 2), known to sigma_px, and outlines_px (n, 2, 2), symmetric, taking the unit
    circle to each outline, known to 3 % and 0.2 px. How wide each is determines the perspective
    also where the middles do not: three on a line and one beside it, say.
    """
    size, origin = float(np.ptp(places_mm, axis=0).max()), places_mm.mean(axis=0)
    to_places = np.array([[size, 0.0, origin[0]], [0.0, size, origin[1]], [0.0, 0.0, 1.0]])
    shift = np.eye(3)
    shift[:2, 2] = -middles_px.mean(axis=0)
    start = shift @ H @ to_places
    places, radii = (places_mm - origin) / size, radii_mm / size
    middles = middles_px + shift[:2, 2]
    per_outline = 1.0 / (
        _OUTLINE_SHARE * np.trace(outlines_px, axis1=1, axis2=2) / 2.0 + _OUTLINE_SIGMA_PX
    )

    def misses(elements: FloatArray) -> FloatArray:
        seen, outlines = circle_outlines(np.append(elements, 1.0).reshape(3, 3), places, radii)
        away = (seen - middles) / sigma_px
        wider = (outlines - outlines_px) * per_outline[:, None, None]
        return np.concatenate([away.ravel(), wider.ravel()])

    elements = (start / start[2, 2]).ravel()[:8]
    refined = least_squares(misses, elements, x_scale="jac", max_nfev=20).x
    found = np.linalg.inv(shift) @ np.append(refined, 1.0).reshape(3, 3) @ np.linalg.inv(to_places)
    return np.asarray(found / found[2, 2])


def circle_outlines(
    H: FloatArray, places_mm: FloatArray, radii_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Middles (n, 2) of circles' outlines, and matrices (n, 2, 2) taking the unit circle to them.

    The dual conic of a circle, `C = c c' - r^2 diag(1, 1, 0)` with `c = [x y 1]'`, is seen as
    `H C H'`; over its last element that is `[[m m' - A A', m], [m', 1]]`, m the middle and A the
    outline (Hartley and Zisserman, 2.2.3, 3.2).
    """
    seen = places_mm @ H[:, :2].T + H[:, 2]
    conic = seen[:, :, None] * seen[:, None, :]
    conic -= radii_mm[:, None, None] ** 2 * (H[:, :2] @ H[:, :2].T)
    conic /= conic[:, 2:, 2:]
    middles = conic[:, :2, 2]
    squares = middles[:, :, None] * middles[:, None, :] - conic[:, :2, :2]
    values, vectors = np.linalg.eigh(squares)
    widths = np.sqrt(np.maximum(values, 0.0))
    return middles, np.asarray((vectors * widths[:, None]) @ np.swapaxes(vectors, 1, 2))


def project(H: FloatArray, places_mm: FloatArray) -> FloatArray:
    """Images (n, 2), px, of points (n, 2) on the plane.

    >>> H = np.array([[10.0, 0.0, 320.0], [0.0, -10.0, 240.0], [0.0, 0.001, 1.0]])
    >>> project(H, np.array([[0.0, 0.0], [15.0, 10.0]])).round(2).tolist()
    [[320.0, 240.0], [465.35, 138.61]]
    """
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
    """Middle of each circle's outline less the image of its centre, (n, 2) px."""
    return circle_outlines(H, places_mm, radii_mm)[0] - project(H, places_mm)
