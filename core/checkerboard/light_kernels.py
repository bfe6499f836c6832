"""Compiled loops: how the light on a board changes about each of its corners.

Light changes smoothly. The flat parts of the four squares about a corner say how steep it is much
better than the pixels along the corner's own edges, where a slope looks like a shift of the edge.
"""

from __future__ import annotations

import math

import numpy as np

from core.arrays import FloatArray
from core.compiled import compiled, inner_loop
from core.images import PixelArray

BOX = 4
"""Side, px, of the boxes whose means stand for the flat parts of the squares."""
_PARTS = 8
"""Of the two squares of one colour four quarters each."""
_FEWEST_PARTS = 5
"""Of the eight: three determine a plane, and two must be left to contradict it."""
_MISFIT_SIGMAS = 3.0
"""Parts may miss the plane by so many standard deviations of a pixel: light that is not linear does
more."""
_SLOPE_NOISE = 25.0
"""The variance of the slopes may be so many times what all quarters would give: with parts on one
side only the slope across is not known."""
_PLANE_SINGULAR = 1e-6
"""Determinant over the product of its diagonal, below which the parts lie on one line."""
_SPARE_PX = 0.01
"""Half the side of a quarter beyond half a box, at least: so that it holds the middle of one."""


@compiled
def box_means(image: PixelArray, out: FloatArray) -> None:
    """Means of the boxes of BOX x BOX px of an image; out (h // BOX, w // BOX)."""
    width = out.shape[1] * BOX
    line = np.zeros(width, np.float32)
    share = np.float32(1.0 / BOX**2)
    for row in range(out.shape[0]):
        a, b = image[BOX * row], image[BOX * row + 1]
        c, d = image[BOX * row + 2], image[BOX * row + 3]
        for i in range(width):
            line[i] = (np.float32(a[i]) + np.float32(b[i])) + (np.float32(c[i]) + np.float32(d[i]))
        for i in range(out.shape[1]):
            at = BOX * i
            out[row, i] = share * (line[at] + line[at + 1] + line[at + 2] + line[at + 3])


@inner_loop
def _quarter_mean(
    boxes: FloatArray, u: float, v: float, half_px: float, full: float, out: FloatArray
) -> bool:
    """Mean place and grey of the boxes within half_px of (u, v): out = (u, v, grey, pixels).

    False where any of them is saturated.
    """
    middle = 0.5 * (BOX - 1)
    first_u = max(0, math.ceil((u - half_px - middle) / BOX))
    last_u = min(boxes.shape[1] - 1, math.floor((u + half_px - middle) / BOX))
    first_v = max(0, math.ceil((v - half_px - middle) / BOX))
    last_v = min(boxes.shape[0] - 1, math.floor((v + half_px - middle) / BOX))
    columns, rows = last_u - first_u + 1, last_v - first_v + 1
    out[3] = 0.0
    if columns <= 0 or rows <= 0:
        return True
    total, most = np.float32(0.0), np.float32(0.0)
    for row in range(first_v, last_v + 1):
        for column in range(first_u, last_u + 1):
            total += boxes[row, column]
            most = max(most, boxes[row, column])
    number = columns * rows
    out[0] = BOX * 0.5 * (first_u + last_u) + middle
    out[1] = BOX * 0.5 * (first_v + last_v) + middle
    out[2], out[3] = total / number, number * BOX * BOX
    return bool(most <= full)


@inner_loop
def _fit_plane(parts: FloatArray, count: int, plane: FloatArray) -> tuple[float, float, float]:
    """Fit plane = (grey at the corner, its slopes by u and v) to parts (n, 4).

    Gives the sum of squares that it leaves, the pixels, and the larger of the two variances of
    its slopes for unit pixel noise (infinite where they are not determined).
    """
    n = u0 = v0 = g0 = 0.0
    for i in range(count):
        w = parts[i, 3]
        n, u0, v0, g0 = n + w, u0 + w * parts[i, 0], v0 + w * parts[i, 1], g0 + w * parts[i, 2]
    u0, v0, g0 = u0 / n, v0 / n, g0 / n
    uu = uv = vv = ug = vg = gg = 0.0
    for i in range(count):
        w, u, v, g = parts[i, 3], parts[i, 0] - u0, parts[i, 1] - v0, parts[i, 2] - g0
        uu, uv, vv = uu + w * u * u, uv + w * u * v, vv + w * v * v
        ug, vg, gg = ug + w * u * g, vg + w * v * g, gg + w * g * g
    det = uu * vv - uv * uv
    if not det > _PLANE_SINGULAR * uu * vv:
        return 0.0, n, math.inf
    by_u, by_v = (vv * ug - uv * vg) / det, (uu * vg - uv * ug) / det
    plane[0], plane[1], plane[2] = g0 - by_u * u0 - by_v * v0, by_u, by_v
    return gg - by_u * ug - by_v * vg, n, max(uu, vv) / det


@inner_loop
def fit_light_planes(
    boxes: FloatArray, at: FloatArray, m: FloatArray, gap_px: float, full: float,
    noise: FloatArray, parts: FloatArray, planes: FloatArray,
) -> bool:  # fmt: skip
    """Fit a plane to the grey of the two squares of either colour about a corner.

    at (2,) px; m (2, 5) as for `fit_corners`; gap_px to keep off the edges; full DN; noise (6,)
    of the grey values; parts (8, 4) is room to work in. planes (2, 3): of the squares with
    x y > 0 and of the others. False where the light is not linear, or not known well enough.
    """
    det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    u_x, u_y, v_x, v_y = m[1, 1] / det, -m[0, 1] / det, -m[1, 0] / det, m[0, 0] / det
    square_px = math.sqrt(abs(1.0 / det))
    gap = gap_px / square_px
    quarter = 0.25 - 0.5 * gap
    side = min(
        1.0 / math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1]),
        1.0 / math.sqrt(m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1]),
    )
    lean = (abs(m[0, 0]) + abs(m[0, 1])) / math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1])
    half_px = max(quarter * side / lean - 0.5 * BOX, 0.5 * BOX + _SPARE_PX)
    for colour in range(2):
        count = 0
        for square in range(2):
            sx = 1.0 if square == 0 else -1.0
            sy = sx if colour == 0 else -sx
            for part in range(4):
                x = 0.5 * sx + quarter * (1.0 if part & 1 else -1.0)
                y = 0.5 * sy + quarter * (1.0 if part & 2 else -1.0)
                u, v = at[0] + u_x * x + u_y * y, at[1] + v_x * x + v_y * y
                if not _quarter_mean(boxes, u, v, half_px, full, parts[count]):
                    return False
                parts[count, 0] -= at[0]
                parts[count, 1] -= at[1]
                count += 1 if parts[count, 3] > 0.0 else 0
        if count < _FEWEST_PARTS:
            return False
        left, pixels, spread = _fit_plane(parts, count, planes[colour])
        variance = min(max(noise[0] + noise[1] * planes[colour, 0], noise[2]), noise[3])
        allowed = (count - 3) * _MISFIT_SIGMAS**2 * variance + pixels * noise[5]
        full_spread = 1.0 / (4.0 * _PARTS * half_px * half_px * (quarter * side) ** 2)
        if left > allowed or spread > _SLOPE_NOISE * full_spread:
            return False
    return True
