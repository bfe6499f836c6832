"""The inner loops of the renderer: rays of a distorted lens, a checkerboard, discs on a plate.

Edges are anti-aliased by supersampling. Around each pixel that an edge comes near, the scene is
looked up at the points of a fixed pattern, spread as pixel integration and a first half pixel of
blur would spread the light; `render.py` adds the rest of the blur. No error function anywhere: the
estimators use one, and the simulation must not share their model.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.site import FloatArray

Float32Array = NDArray[np.float32]

PATTERN_SIGMA_PX = 0.5
"""Gaussian blur that the sampling pattern contains beside the pixel's own square."""

PATTERN_POINTS = 128


def sample_pattern() -> FloatArray:
    """Points (n, 2) px, spread as a square pixel convolved with a Gaussian of half a pixel.

    A low-discrepancy sequence (R2) through the inverse distribution of each axis, made symmetric.
    Then the fractions of each coordinate are spread evenly: the pixels that share an edge add up
    to exactly where it lies, wherever it falls between their centres.
    """
    grid = np.linspace(-3.5, 3.5, 7001)
    density = np.exp(-0.5 * (grid / PATTERN_SIGMA_PX) ** 2)
    square = np.convolve(density, np.ones(1001), mode="same")
    cumulative = np.cumsum(square) / square.sum()
    step = np.array([0.7548776662466927, 0.5698402909980532])
    uniform = (0.5 + np.arange(PATTERN_POINTS // 2)[:, None] * step) % 1.0
    half = np.interp(uniform, cumulative, grid)
    points = np.concatenate([half, -half])
    whole = np.floor(points)
    rank = np.argsort(np.argsort(points - whole, axis=0), axis=0)
    return np.asarray(whole + (rank + 0.5) / PATTERN_POINTS)


@njit(cache=True, nogil=True)
def undistorted_rays(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, k: FloatArray
) -> Float32Array:  # pragma: no cover - compiled
    """Ray directions (x/z, y/z) of every pixel centre and one pixel beyond each border.

    Newton's method on OpenCV's distortion model; shape (height + 2, width + 2, 2).
    """
    k1, k2, p1, p2, k3 = k[0], k[1], k[2], k[3], k[4]
    rays = np.empty((height + 2, width + 2, 2), np.float32)
    for v in range(height + 2):
        for u in range(width + 2):
            xd, yd = (u - 1 - cx) / fx, (v - 1 - cy) / fy
            x, y = xd, yd
            for _ in range(20):
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
                ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
                ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
                a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                det = a * d - b * b
                dx, dy = (d * ex - b * ey) / det, (a * ey - b * ex) / det
                x -= dx
                y -= dy
                if dx * dx + dy * dy < 1e-24:
                    break
            rays[v, u, 0] = x
            rays[v, u, 1] = y
    return rays


@njit(cache=True, nogil=True)
def _look(
    rays: Float32Array, R: FloatArray, centre: FloatArray, sheet: FloatArray, row: FloatArray
) -> None:  # pragma: no cover - compiled
    """Where the rays of one pixel row meet the bowed sheet: row (width, 2), target frame, mm.

    R, centre: T_target_camera. sheet: bow, then middle and half size along x and y, mm.
    """
    bow = sheet[0]
    for u in range(rays.shape[0]):
        a, b = rays[u, 0], rays[u, 1]
        dx = R[0, 0] * a + R[0, 1] * b + R[0, 2]
        dy = R[1, 0] * a + R[1, 1] * b + R[1, 2]
        dz = R[2, 0] * a + R[2, 1] * b + R[2, 2]
        along = -centre[2] / dz
        if bow != 0.0:
            for _ in range(2):
                xi = (centre[0] + along * dx - sheet[1]) / sheet[3]
                eta = (centre[1] + along * dy - sheet[2]) / sheet[4]
                if xi * xi + eta * eta < 8.0:  # beyond the sheet its bow means nothing
                    along = (bow * (1.0 - 0.5 * (xi * xi + eta * eta)) - centre[2]) / dz
        row[u, 0] = centre[0] + along * dx
        row[u, 1] = centre[1] + along * dy


@njit(cache=True, nogil=True)
def _cell(lines: FloatArray, guess: int, x: float) -> int:  # pragma: no cover - compiled
    """Index of the cell that holds x, searched from a guess; the outer lines are at infinity."""
    while x < lines[guess]:
        guess -= 1
    while x >= lines[guess + 1]:
        guess += 1
    return guess


@njit(cache=True, nogil=True)
def render_board(
    rays: Float32Array,
    R: FloatArray,
    centre: FloatArray,
    sheet: FloatArray,
    x_lines: FloatArray,
    y_lines: FloatArray,
    pattern: FloatArray,
    white: float,
    black: float,
    out: Float32Array,
) -> None:  # pragma: no cover - compiled
    """Reflectance of a checkerboard on white: out (height, width).

    x_lines, y_lines: the printed lines between a first one at -inf and a last one at +inf; the
    cell after the first printed lines is black.
    """
    height, width = out.shape
    nx, ny = len(x_lines) - 3, len(y_lines) - 3
    reach = np.abs(pattern).max()
    rows = np.empty((3, width + 2, 2))
    above, here, below = rows[0], rows[1], rows[2]
    _look(rays[0], R, centre, sheet, above)
    _look(rays[1], R, centre, sheet, here)
    for v in range(height):
        _look(rays[v + 2], R, centre, sheet, below)
        i = j = 0
        for u in range(width):
            x, y = here[u + 1, 0], here[u + 1, 1]
            xu, yu = 0.5 * (here[u + 2, 0] - here[u, 0]), 0.5 * (here[u + 2, 1] - here[u, 1])
            xv, yv = (
                0.5 * (below[u + 1, 0] - above[u + 1, 0]),
                0.5 * (below[u + 1, 1] - above[u + 1, 1]),
            )
            i, j = _cell(x_lines, i, x), _cell(y_lines, j, y)
            reach_x = reach * (abs(xu) + abs(xv))
            reach_y = reach * (abs(yu) + abs(yv))
            if (
                x - x_lines[i] > reach_x
                and x_lines[i + 1] - x > reach_x
                and y - y_lines[j] > reach_y
                and y_lines[j + 1] - y > reach_y
            ):
                dark = 1.0 if 1 <= i <= nx and 1 <= j <= ny and (i + j) % 2 == 0 else 0.0
            else:
                hits = 0
                for n in range(len(pattern)):
                    du, dv = pattern[n, 0], pattern[n, 1]
                    p = _cell(x_lines, i, x + xu * du + xv * dv)
                    q = _cell(y_lines, j, y + yu * du + yv * dv)
                    if 1 <= p <= nx and 1 <= q <= ny and (p + q) % 2 == 0:
                        hits += 1
                dark = hits / len(pattern)
            out[v, u] = white + (black - white) * dark
        above, here, below = here, below, above


@njit(cache=True, nogil=True)
def render_discs(
    rays: Float32Array,
    R: FloatArray,
    centre: FloatArray,
    discs: FloatArray,
    plate: FloatArray,
    pattern: FloatArray,
    greys: FloatArray,
    out: Float32Array,
) -> None:  # pragma: no cover - compiled
    """Reflectance of white discs on a black plate before a grey background: out (height, width).

    discs (n, 3): x, y, radius in WM, mm. plate: x0, y0, x1, y1. greys: white, black, background.
    """
    height, width = out.shape
    reach = math.sqrt((pattern * pattern).sum(axis=1).max())
    flat = np.zeros(5)
    rows = np.empty((3, width + 2, 2))
    above, here, below = rows[0], rows[1], rows[2]
    _look(rays[0], R, centre, flat, above)
    _look(rays[1], R, centre, flat, here)
    for v in range(height):
        _look(rays[v + 2], R, centre, flat, below)
        for u in range(width):
            x, y = here[u + 1, 0], here[u + 1, 1]
            xu, yu = 0.5 * (here[u + 2, 0] - here[u, 0]), 0.5 * (here[u + 2, 1] - here[u, 1])
            xv, yv = (
                0.5 * (below[u + 1, 0] - above[u + 1, 0]),
                0.5 * (below[u + 1, 1] - above[u + 1, 1]),
            )
            margin = reach * math.sqrt(xu * xu + yu * yu + xv * xv + yv * yv)
            clear = max(plate[0] - x, x - plate[2], plate[1] - y, y - plate[3])
            if clear > margin:
                out[v, u] = greys[2]
                continue
            disc, gap = 0, np.inf  # the nearest disc, and how far its edge is
            for d in range(len(discs)):
                dx, dy = x - discs[d, 0], y - discs[d, 1]
                away = math.sqrt(dx * dx + dy * dy) - discs[d, 2]
                if away < gap:
                    disc, gap = d, away
            if abs(clear) > margin and abs(gap) > margin:
                out[v, u] = greys[0] if gap < 0.0 else greys[1]
                continue
            total = 0.0
            for n in range(len(pattern)):
                du, dv = pattern[n, 0], pattern[n, 1]
                dx, dy = x + xu * du + xv * dv, y + yu * du + yv * dv
                if dx < plate[0] or dx > plate[2] or dy < plate[1] or dy > plate[3]:
                    total += greys[2]
                    continue
                dx -= discs[disc, 0]
                dy -= discs[disc, 1]
                inside = dx * dx + dy * dy < discs[disc, 2] * discs[disc, 2]
                total += greys[0] if inside else greys[1]
            out[v, u] = total / len(pattern)
        above, here, below = here, below, above
