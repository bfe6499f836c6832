"""The inner loops of the renderer: rays of a distorted lens, a checkerboard, discs on a plate.

Every pixel is the mean of the scene under its response, exact where edges are straight over a few
pixels: the share of an edge is tabulated, that of two that cross is an integral along both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.arrays import FloatArray, IntArray
from core.compiled import kept_on_disk, part_of_loops

Float32Array = NDArray[np.float32]

Slopes = tuple[float, float, float]
"""A target coordinate at a pixel, mm, and how it grows with u and v, mm per px."""

PER_PX = 128
"""Table entries per pixel; linear between them, right to 1e-5."""

SLOPES = 32
"""Steps from an edge along an image axis to a diagonal one."""

compiled = kept_on_disk(nogil=True)
inner_loop = part_of_loops(nogil=True)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


class Response(NamedTuple):
    """Tables of a pixel's response b(u) b(v) to light; all are symmetric about their middle."""

    reach_px: float
    """No light comes from further away, along either axis."""
    variance_px2: float
    """Of b."""
    density: FloatArray
    """(n,) b, per px."""
    edges: FloatArray
    """(SLOPES + 1, m) share of u + p v < d for p from 0 to 1; p = 0 is the integral of b."""


@compiled
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


@inner_loop
def _look(
    rays: Float32Array, R: FloatArray, centre: FloatArray, sheet: FloatArray, row: FloatArray
) -> None:  # pragma: no cover - compiled
    """Where the rays of one pixel row meet the bowed sheet: row (width, 2), target frame, mm.

    R, centre: T_target_camera. sheet: bow, then middle and half size along x and y, mm.
    """
    bow, per_x, per_y = sheet[0], 1.0, 1.0
    if bow != 0.0:
        per_x, per_y = 1.0 / sheet[3], 1.0 / sheet[4]
    for u in range(rays.shape[0]):
        a, b = rays[u, 0], rays[u, 1]
        dx = R[0, 0] * a + R[0, 1] * b + R[0, 2]
        dy = R[1, 0] * a + R[1, 1] * b + R[1, 2]
        dz = R[2, 0] * a + R[2, 1] * b + R[2, 2]
        per_z = 1.0 / dz
        along = -centre[2] * per_z
        if bow != 0.0:
            for _ in range(2):
                xi = (centre[0] + along * dx - sheet[1]) * per_x
                eta = (centre[1] + along * dy - sheet[2]) * per_y
                if xi * xi + eta * eta < 8.0:  # beyond the sheet its bow means nothing
                    along = (bow * (1.0 - 0.5 * (xi * xi + eta * eta)) - centre[2]) * per_z
        row[u, 0] = centre[0] + along * dx
        row[u, 1] = centre[1] + along * dy


@inner_loop
def _at(table: FloatArray, x_px: float) -> float:  # pragma: no cover - compiled
    """Table value at a distance from the middle; the end values go on for ever."""
    at = x_px * PER_PX + (len(table) // 2)
    if at <= 0.0:
        return float(table[0])
    k = int(at)
    if k >= len(table) - 1:
        return float(table[-1])
    return float(table[k] + (at - k) * (table[k + 1] - table[k]))


@inner_loop
def edge_share(
    response: Response, edge: tuple[float, float, float]
) -> float:  # pragma: no cover - compiled
    """Share of a pixel from where e[0] + e[1] u + e[2] v > 0, (u, v) px from its centre."""
    steep, flat = abs(edge[1]), abs(edge[2])
    if steep < flat:
        steep, flat = flat, steep
    slope = flat / steep * SLOPES
    k = min(int(slope), SLOPES - 1)
    near = _at(response.edges[k], edge[0] / steep)
    return near + (slope - k) * (_at(response.edges[k + 1], edge[0] / steep) - near)


@inner_loop
def wedge_share(
    response: Response, first: tuple[float, float, float], second: tuple[float, float, float]
) -> float:  # pragma: no cover - compiled
    """Share of a pixel from beyond both of two edges that cross; each as in `edge_share`.

    Axes are swapped and reversed until the region is right of u = u0 + p (v - v0) and above
    v = v0 + q (u - u0). Around it lie the quadrant left of and below the crossing (u0, v0), what is
    left of the first edge above v0, and what is below the second right of u0.
    """
    a, b = first, second
    if abs(a[1] * b[2]) < abs(a[2] * b[1]):  # the first edge is along u rather than v
        a, b = second, first
    determinant = a[1] * b[2] - a[2] * b[1]
    sign_u = 1.0 if a[1] > 0.0 else -1.0
    sign_v = 1.0 if b[2] > 0.0 else -1.0
    u0 = sign_u * (a[2] * b[0] - a[0] * b[2]) / determinant
    v0 = sign_v * (a[0] * b[1] - a[1] * b[0]) / determinant
    p, q = -sign_u * sign_v * a[2] / a[1], -sign_u * sign_v * b[1] / b[2]
    corner = _at(response.edges[0], u0) * _at(response.edges[0], v0)
    return 1.0 - corner - _beside(response, u0, v0, p) - _beside(response, v0, u0, q)


@inner_loop
def _beside(
    response: Response, u0: float, v0: float, slope: float
) -> float:  # pragma: no cover - compiled
    """Share of v > v0, u < u0 + slope (v - v0): the integral of b(v) times that of b(u)."""
    start = max(v0, -response.reach_px)
    half = 0.5 * (response.reach_px - start)
    if half <= 0.0:
        return 0.0
    total = 0.0
    for n in range(len(_NODES)):
        v = start + half * (1.0 + _NODES[n])
        inner = _at(response.edges[0], u0 + slope * (v - v0))
        total += _WEIGHTS[n] * _at(response.density, v) * inner
    return half * total


@inner_loop
def _slopes(
    above: FloatArray, here: FloatArray, below: FloatArray, u: int
) -> tuple[Slopes, Slopes]:  # pragma: no cover - compiled
    """Target coordinates at pixel u of three rows from `_look`, which are two pixels longer."""
    x_slopes = (
        here[u + 1, 0],
        0.5 * (here[u + 2, 0] - here[u, 0]),
        0.5 * (below[u + 1, 0] - above[u + 1, 0]),
    )
    y_slopes = (
        here[u + 1, 1],
        0.5 * (here[u + 2, 1] - here[u, 1]),
        0.5 * (below[u + 1, 1] - above[u + 1, 1]),
    )
    return x_slopes, y_slopes


@inner_loop
def _cells(
    lines: FloatArray, guess: int, x: float, reach: float
) -> tuple[int, int]:  # pragma: no cover - compiled
    """First and last cell that x +- reach touches, searched from a guess for the first."""
    first = guess
    while x - reach < lines[first]:
        first -= 1
    while x - reach >= lines[first + 1]:
        first += 1
    last = first
    while x + reach >= lines[last + 1]:
        last += 1
    return first, last


@inner_loop
def _dark(i: int, j: int, nx: int, ny: int) -> float:  # pragma: no cover - compiled
    """1.0 for a black square, 0.0 for a white one and beyond the board."""
    return 1.0 if 1 <= i <= nx and 1 <= j <= ny and (i + j) % 2 == 0 else 0.0


@inner_loop
def _darkness(
    response: Response,
    x_lines: FloatArray,
    y_lines: FloatArray,
    x: Slopes,
    y: Slopes,
    first: tuple[int, int],
    last: tuple[int, int],
) -> float:  # pragma: no cover - compiled
    """Share of black in a pixel that touches cells first to last, (i, j) each.

    The first cell's grey, then what changes beyond each line, then beyond each crossing.
    """
    nx, ny = len(x_lines) - 3, len(y_lines) - 3
    i0, j0 = first
    dark = _dark(i0, j0, nx, ny)
    for i in range(i0 + 1, last[0] + 1):
        step = _dark(i, j0, nx, ny) - _dark(i - 1, j0, nx, ny)
        if step != 0.0:
            dark += step * edge_share(response, (x[0] - x_lines[i], x[1], x[2]))
    for j in range(j0 + 1, last[1] + 1):
        step = _dark(i0, j, nx, ny) - _dark(i0, j - 1, nx, ny)
        if step != 0.0:
            dark += step * edge_share(response, (y[0] - y_lines[j], y[1], y[2]))
        for i in range(i0 + 1, last[0] + 1):
            step = _dark(i, j, nx, ny) - _dark(i - 1, j, nx, ny)
            step -= _dark(i, j - 1, nx, ny) - _dark(i - 1, j - 1, nx, ny)
            if step != 0.0:
                right_of = (x[0] - x_lines[i], x[1], x[2])
                below = (y[0] - y_lines[j], y[1], y[2])
                dark += step * wedge_share(response, right_of, below)
    return dark


@compiled
def render_board(
    rays: Float32Array,
    R: FloatArray,
    centre: FloatArray,
    sheet: FloatArray,
    x_lines: FloatArray,
    y_lines: FloatArray,
    response: Response,
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
    rows = np.empty((3, width + 2, 2))
    above, here, below = rows[0], rows[1], rows[2]
    _look(rays[0], R, centre, sheet, above)
    _look(rays[1], R, centre, sheet, here)
    for v in range(height):
        _look(rays[v + 2], R, centre, sheet, below)
        i = j = 0
        for u in range(width):
            x, y = _slopes(above, here, below, u)
            reach_x = response.reach_px * (abs(x[1]) + abs(x[2]))
            reach_y = response.reach_px * (abs(y[1]) + abs(y[2]))
            i, last_i = _cells(x_lines, i, x[0], reach_x)
            j, last_j = _cells(y_lines, j, y[0], reach_y)
            if i == last_i and j == last_j:
                dark = _dark(i, j, nx, ny)
            else:
                dark = _darkness(response, x_lines, y_lines, x, y, (i, j), (last_i, last_j))
            out[v, u] = white + (black - white) * dark
        above, here, below = here, below, above


@compiled
def add_discs(
    rays: Float32Array,
    R: FloatArray,
    centre: FloatArray,
    discs: FloatArray,
    boxes: IntArray,
    response: Response,
    contrast: float,
    out: Float32Array,
) -> None:  # pragma: no cover - compiled
    """Add discs to a rendered plate: out (height, width).

    discs (n, 3): x, y, radius in WM, mm. boxes (n, 4): where each is seen, u0, v0, u1, v1 px.
    contrast: disc minus plate. An outline is straight within a pixel's reach, but for its mean
    sagitta there.
    """
    flat = np.zeros(5)
    for d in range(len(discs)):
        u0, v0, u1, v1 = boxes[d]
        rows = np.empty((3, max(u1 - u0, 0) + 2, 2))
        above, here, below = rows[0], rows[1], rows[2]
        for v in range(v0, v1):
            _look(rays[v, u0 : u1 + 2], R, centre, flat, above)
            _look(rays[v + 1, u0 : u1 + 2], R, centre, flat, here)
            _look(rays[v + 2, u0 : u1 + 2], R, centre, flat, below)
            for u in range(u0, u1):
                x, y = _slopes(above, here, below, u - u0)
                out[v, u] += contrast * _disc_share(response, x, y, discs[d])


@inner_loop
def _disc_share(
    response: Response, x: Slopes, y: Slopes, disc: FloatArray
) -> float:  # pragma: no cover - compiled
    """Share of a disc (x, y, radius) in a pixel."""
    dx, dy = x[0] - disc[0], y[0] - disc[1]
    away = max(math.sqrt(dx * dx + dy * dy), 1e-9)
    dx, dy = dx / away, dy / away
    across = x[1] * dy - y[1] * dx, x[2] * dy - y[2] * dx
    square = across[0] * across[0] + across[1] * across[1]
    inside = disc[2] - away - 0.5 * response.variance_px2 * square / disc[2]
    return edge_share(response, (inside, -x[1] * dx - y[1] * dy, -x[2] * dx - y[2] * dy))
