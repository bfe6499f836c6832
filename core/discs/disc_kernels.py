"""Compiled loops over pixels: the grey-value model of a bright disc."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.arrays import FloatArray, IntArray
from core.compiled import compiled, inner_loop
from core.grey_fit import MIN_PIXELS, edge, pixel_weight, reduce_to_shift, solve_keeping

DISC_PARAMETERS = 12
"""Of the model: shift 2, outline 3, offset and its slopes 3, gain and its slopes 3, blur 1."""
_LEAST_BLUR_PX, _MOST_BLUR_PX = 0.25, 12.0
"""Bounds on the blur, px. A pixel's own width blurs by 0.29 px; a camera that sharpens takes some
of that off. 12 is chosen: three times the blur of the tests' image out of focus."""
_GOLDEN = 0.381966
"""The smaller part of 1 cut in the golden section."""
_BLUR = 11
"""Index of the blur among the parameters."""
_MOST_STEP_BLURS = 1.0
"""A step goes so many blur widths at most: further away the edge's profile is no straight line."""
_INSIDE = 8
"""Index of the gain: its derivative says how far inside the outline a pixel is."""
_FLAT = 0.1
"""A pixel within this of 0 or 1 is black or white, off the edge: there the noise is read."""
_BLOCK = 128  # pixels at a time; their 12 derivatives, 12 KB, stay in the fastest cache
Pixels = NDArray[Any]
"""(h, w) grey values: uint8, uint16 or float32."""


@inner_loop
def _disc_pixel(u: float, v: float, p: FloatArray, rows: FloatArray, at: int) -> float:
    """Model grey value of one pixel of a disc; its derivatives go into rows[:, at].

    p: shift u, v, the symmetric matrix that takes the unit circle to the outline (a, b, c),
    offset and slopes, gain and slopes, blur. With q = A^-1 x, rho = |q| and h = grad rho the
    signed distance is (rho - 1) / |h|; it changes by -(h . dx) / |h| with a shift and by
    -(h . dA q) / |h| with the outline.
    """
    a, b, c = p[2], p[3], p[4]
    per_det = 1.0 / (a * c - b * b)
    du, dv = u - p[0], v - p[1]
    qx, qy = (c * du - b * dv) * per_det, (a * dv - b * du) * per_det
    rho = math.sqrt(qx * qx + qy * qy) + 1e-9
    per_rho_det = per_det / rho
    hx, hy = (c * qx - b * qy) * per_rho_det, (a * qy - b * qx) * per_rho_det
    per_norm = 1.0 / (math.sqrt(hx * hx + hy * hy) + 1e-12)
    rise, slope, by_blur = edge((1.0 - rho) * per_norm, p[_BLUR])
    inside = 0.5 * (1.0 + rise)
    gain = p[8] + p[9] * u + p[10] * v
    outward = 0.5 * gain * slope * per_norm
    by_x, by_y = outward * hx, outward * hy
    rows[0, at], rows[1, at] = by_x, by_y
    rows[2, at], rows[3, at], rows[4, at] = by_x * qx, by_x * qy + by_y * qx, by_y * qy
    rows[5, at], rows[6, at], rows[7, at] = 1.0, u, v
    rows[8, at], rows[9, at], rows[10, at] = inside, inside * u, inside * v
    rows[_BLUR, at] = 0.5 * gain * by_blur
    return float(p[5] + p[6] * u + p[7] * v + gain * inside)


@inner_loop
def _add_up(
    rows: FloatArray,
    miss: FloatArray,
    weight: FloatArray,
    count: int,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Add `count` pixels to the weighted normal equations (lower half)."""
    for a in range(len(right)):
        total = 0.0
        for i in range(count):
            total += weight[i] * rows[a, i] * miss[i]
        right[a] += total
        for b in range(a + 1):
            total = 0.0
            for i in range(count):
                total += weight[i] * rows[a, i] * rows[b, i]
            normal[a, b] += total


@inner_loop
def _span(p: FloatArray, further_px: float, dv: float) -> tuple[float, float]:
    """Where the row dv below a disc's centre lies inside its outline grown by further_px.

    |A^-1 (du, dv)| < 1 is quadratic in du. Gives first > last where it does not cross.
    """
    a, b, c = p[2] + further_px, p[3], p[4] + further_px
    det = a * c - b * b
    if not (a > 0.0 and det > 0.0):
        return 1.0, -1.0
    square = b * b + c * c
    middle = b * (a + c) * dv / square
    root = (square - dv * dv) * det * det
    if root <= 0.0:
        return 1.0, -1.0
    half = math.sqrt(root) / square
    return middle - half, middle + half


@inner_loop
def _lattice_step(every: int) -> int:
    """By how much the columns taken of one row lie beside those of the row above.

    Near the golden section of `every`: pixels are then spread evenly in all directions.
    """
    return max(1, int(_GOLDEN * every + 0.5))


@inner_loop
def _gather_disc(
    image: Pixels, at: FloatArray, p: FloatArray, reach_px: float, every: int, pixels: FloatArray
) -> int:
    """Collect (u, v, grey) of pixels nearer than reach_px to an outline; their number comes back.

    Of all these one in `every`, on a lattice that the image fixes: which ones are taken must not
    depend on where the outline was supposed to be.
    """
    count, per_row = 0, _lattice_step(every)
    u0, v0 = at[0] + p[0], at[1] + p[1]
    tall = math.sqrt((p[4] + reach_px) * (p[4] + reach_px) + p[3] * p[3])
    for row in range(max(0, math.ceil(v0 - tall)), min(image.shape[0], int(v0 + tall) + 1)):
        first, last = _span(p, reach_px, row - v0)
        gap_first, gap_last = _span(p, -reach_px, row - v0)
        gap_from, gap_to = math.ceil(u0 + gap_first), math.floor(u0 + gap_last)
        column, end = max(0, math.ceil(u0 + first)), min(image.shape[1] - 1, math.floor(u0 + last))
        while column <= end:
            if gap_from <= column <= gap_to:
                column = gap_to + 1
                continue
            if (column + per_row * row) % every == 0 and count < pixels.shape[1]:
                pixels[0, count], pixels[1, count] = column - at[0], row - at[1]
                pixels[2, count] = image[row, column]
                count += 1
            column += 1
    return count


@inner_loop
def _plausible(p: FloatArray, size: float) -> bool:
    """Whether the outline is still an ellipse, near where it was looked for, about as large."""
    if not p[2] + p[4] < 2.0 * size:
        return False
    if not (p[2] > 1.0 and p[4] > 1.0 and p[2] * p[4] > p[3] * p[3]):
        return False
    return bool(abs(p[0]) + abs(p[1]) <= max(p[2], p[4]))


@inner_loop
def _hold_blur(p: FloatArray, normal: FloatArray, right: FloatArray) -> None:
    """Take the blur out of the equations where it would leave its bounds, else it drags the rest.

    That is where the images are sharper than any edge that the model knows.
    """
    down, up = p[_BLUR] <= _LEAST_BLUR_PX, p[_BLUR] >= _MOST_BLUR_PX
    if (down and right[_BLUR] < 0.0) or (up and right[_BLUR] > 0.0):
        normal[_BLUR, :], normal[_BLUR, _BLUR], right[_BLUR] = 0.0, 1.0, 0.0


@inner_loop
def _advance(
    normal: FloatArray, right: FloatArray, factor: FloatArray, step: FloatArray, p: FloatArray
) -> tuple[bool, float]:
    """Take a Gauss-Newton step of the parameters p; factor and step are room to work in.

    Gives whether the normal matrix is positive, and the largest change, px, of what has this
    unit: place, outline and blur. A disc is symmetric, so that its place comes to rest before its
    size and its blur do.
    """
    if not solve_keeping(normal, right, factor, step, len(p)):
        return False, 0.0
    moved_px = abs(step[_BLUR])
    for a in range(5):
        moved_px = max(moved_px, abs(step[a]))
    share = min(1.0, _MOST_STEP_BLURS * p[_BLUR] / (moved_px + 1e-30))
    blur_px = p[_BLUR]
    for a in range(len(p)):
        p[a] += share * step[a]
    p[_BLUR] = min(max(p[_BLUR], _LEAST_BLUR_PX, 0.5 * blur_px), _MOST_BLUR_PX)
    moved_px = abs(p[_BLUR] - blur_px)
    for a in range(5):
        moved_px = max(moved_px, share * abs(step[a]))
    return True, moved_px


@inner_loop
def _equations(
    pixels: FloatArray, count: int, p: FloatArray, limits: FloatArray, rows: FloatArray,
    miss: FloatArray, weight: FloatArray, normal: FloatArray, right: FloatArray,
) -> None:  # fmt: skip
    """Set up the weighted normal equations (lower half), with misses and weights by pixel."""
    normal[:, :], right[:] = 0.0, 0.0
    for first in range(0, count, _BLOCK):
        block = min(_BLOCK, count - first)
        for at in range(block):
            i = first + at
            model = _disc_pixel(pixels[0, i], pixels[1, i], p, rows, at)
            miss[i], pixels[3, i] = pixels[2, i] - model, rows[_INSIDE, at]
            noise_dn2 = limits[1] + (limits[3] - limits[1]) * rows[_INSIDE, at]
            weight[i] = pixel_weight(miss[i], math.sqrt(noise_dn2))
            if model >= limits[0] <= pixels[2, i]:
                weight[i] = 0.0
        _add_up(rows, miss[first:], weight[first:], block, normal, right)
    _hold_blur(p, normal, right)


@inner_loop
def _room(state: FloatArray, reach_px: FloatArray) -> int:
    """Pixels that any of the discs may need."""
    most = 0.0
    for k in range(len(state)):
        size = max(state[k, 2], state[k, 4]) + abs(state[k, 3]) + reach_px[k] + 1.0
        most = max(most, size * min(reach_px[k] + 1.0, size))
    return int(4.0 * math.pi * most) + 64


@inner_loop
def _judge(
    inside: FloatArray, miss: FloatArray, weight: FloatArray, count: int, figures: FloatArray
) -> None:
    """What one disc's pixels say of the fit; see `fit_discs`."""
    for i in range(count):
        square = weight[i] * miss[i] * miss[i]
        figures[0] += square
        figures[1] += weight[i]
        if weight[i] > 0.0:
            figures[2] += 1.0
        if weight[i] > 0.5:
            figures[3] += 1.0
        if inside[i] < _FLAT:
            figures[5] += square
            figures[6] += weight[i]
        elif inside[i] > 1.0 - _FLAT:
            figures[7] += square
            figures[8] += weight[i]


@compiled
def fit_discs(
    image: Pixels,
    points: FloatArray,
    reach_px: FloatArray,
    every: IntArray,
    limits: FloatArray,
    iterations: int,
    state: FloatArray,
    information: FloatArray,
    figures: FloatArray,
) -> None:
    """Fit a bright disc at each point.

    image (h, w) DN; points (n, 2) px; reach_px (n,) about the outline; every (n,): which share
    of the pixels to use; limits: saturation DN, noise DN^2 in black for the pixel weights (0:
    none), the change, px, after which the next step is not worth taking, noise DN^2 in white:
    light makes noise of its own. Residuals and weights are those of
    the parameters that come back, not of those before the last step. state (n, 12) in and out;
    information (n, 2, 2) as in `fit_corners`; figures (n, 9): weighted residual
    sum of squares, weight sum, pixels near the outline, pixels there with
    weight above a half, 1 if usable; the first two for black pixels alone, and for white ones.
    """
    n = DISC_PARAMETERS
    normal, right, factor = np.zeros((n, n)), np.zeros(n), np.zeros((n, n))
    step = np.zeros(n)
    room = _room(state, reach_px)
    pixels, rows = np.zeros((4, room)), np.zeros((n, _BLOCK))
    miss, weight = np.zeros(room), np.ones(room)
    for k in range(len(points)):
        p = state[k]
        figures[k, :] = 0.0
        count = _gather_disc(image, points[k], p, reach_px[k], every[k], pixels)
        if count < MIN_PIXELS:
            continue
        usable, moved_px, size = True, math.inf, p[2] + p[4]
        for turn in range(iterations + 1):
            _equations(pixels, count, p, limits, rows, miss, weight, normal, right)
            if turn == iterations or moved_px < limits[2]:
                break
            usable, moved_px = _advance(normal, right, factor, step, p)
            usable = usable and _plausible(p, size)
            if not usable:
                break
        _judge(pixels[3], miss, weight, count, figures[k])
        if usable:
            usable = reduce_to_shift(normal, information[k])
        figures[k, 4] = 1.0 if usable else 0.0
