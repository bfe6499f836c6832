"""Compiled loops over pixels: the grey-value model of a checkerboard corner."""

from __future__ import annotations

import math

import numpy as np

from core.pixel_fit import (
    MIN_PIXELS,
    SETTLED_PX,
    advance,
    compiled,
    edge,
    pixel_weight,
    reduce_to_shift,
    sum_up,
)
from core.site import FloatArray

CORNER_PARAMETERS = 9


@compiled
def _corner_pixel(
    u: float, v: float, m: FloatArray, p: FloatArray, frame: FloatArray, rows: FloatArray, at: int
) -> float:
    """Model grey value at an offset from the predicted corner; derivatives go into rows[:, at].

    m (2, 5): the board's coordinates about the corner, in squares, as polynomials of the
    pixel's offset; p: shift u, v, offset and its slopes, gain and its slopes, blur; frame: see
    `_corner_frame`.
    """
    du, dv = u - p[0], v - p[1]
    x = du * (m[0, 0] + m[0, 2] * du + m[0, 3] * dv) + dv * (m[0, 1] + m[0, 4] * dv)
    y = du * (m[1, 0] + m[1, 2] * du + m[1, 3] * dv) + dv * (m[1, 1] + m[1, 4] * dv)
    ex, ex_d, ex_s = edge(x * frame[0], p[8])
    ey, ey_d, ey_s = edge(y * frame[1], p[8])
    gain = p[5] + p[6] * u + p[7] * v
    sign = ex * ey
    by_x, by_y = gain * ey * ex_d, gain * ex * ey_d
    rows[0, at] = -(by_x * frame[2] + by_y * frame[4])
    rows[1, at] = -(by_x * frame[3] + by_y * frame[5])
    rows[2, at], rows[3, at], rows[4, at] = 1.0, u, v
    rows[5, at], rows[6, at], rows[7, at] = sign, sign * u, sign * v
    rows[8, at] = gain * (ey * ex_s + ex * ey_s)
    return float(p[2] + p[3] * u + p[4] * v + gain * sign)


@compiled
def _corner_frame(m: FloatArray, frame: FloatArray) -> None:
    """Px per square along x and y, and the slopes of m's linear part in units of those."""
    px_x = 1.0 / math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1])
    px_y = 1.0 / math.sqrt(m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1])
    frame[0], frame[1] = px_x, px_y
    frame[2], frame[3] = m[0, 0] * px_x, m[0, 1] * px_x
    frame[4], frame[5] = m[1, 0] * px_y, m[1, 1] * px_y


@compiled
def _gather_corner(
    image: FloatArray,
    at: FloatArray,
    half: float,
    m: FloatArray,
    frame: FloatArray,
    limits: FloatArray,
    pixels: FloatArray,
) -> int:
    """Collect (u, v, grey) of the pixels that tell about a corner; their number comes back.

    Not those of a neighbouring corner, nor those too far from both edges.
    """
    count = 0
    reach, band_x, band_y = limits[0], limits[1] / frame[0], limits[1] / frame[1]
    for row in range(
        max(0, math.floor(at[1] - half)), min(image.shape[0], math.ceil(at[1] + half) + 1)
    ):
        v = row - at[1]
        for column in range(
            max(0, math.floor(at[0] - half)), min(image.shape[1], math.ceil(at[0] + half) + 1)
        ):
            u = column - at[0]
            x = abs(u * (m[0, 0] + m[0, 2] * u + m[0, 3] * v) + v * (m[0, 1] + m[0, 4] * v))
            y = abs(u * (m[1, 0] + m[1, 2] * u + m[1, 3] * v) + v * (m[1, 1] + m[1, 4] * v))
            if x > reach or y > reach or (x > band_x and y > band_y):
                continue
            pixels[0, count], pixels[1, count], pixels[2, count] = u, v, image[row, column]
            count += 1
    return count


@compiled
def _start_corner(pixels: FloatArray, count: int, m: FloatArray, p: FloatArray) -> bool:
    """Start offset and gain from the mean of the bright and of the dark squares."""
    same, other, n_same, n_other = 0.0, 0.0, 0, 0
    for i in range(count):
        u, v = pixels[0, i], pixels[1, i]
        if (m[0, 0] * u + m[0, 1] * v) * (m[1, 0] * u + m[1, 1] * v) > 0.0:
            same += pixels[2, i]
            n_same += 1
        else:
            other += pixels[2, i]
            n_other += 1
    if n_same < 8 or n_other < 8:
        return False
    same, other = same / n_same, other / n_other
    p[2], p[5] = 0.5 * (same + other), 0.5 * (same - other)
    return True


@compiled
def fit_corners(
    image: FloatArray,
    points: FloatArray,
    maps: FloatArray,
    half: FloatArray,
    scale: FloatArray,
    limits: FloatArray,
    iterations: int,
    state: FloatArray,
    information: FloatArray,
    figures: FloatArray,
) -> None:
    """Fit the corner model at each predicted point.

    image (h, w) DN; points (n, 2) px; maps (n, 2, 5) squares per px, px^2; half (n,) px;
    scale (n,) DN noise for the pixel weights, 0 for none; limits: reach in squares, band about the
    edges in px, saturation DN. At most `iterations` steps.
    state (n, 9) out; its blur, in, is where the fit starts. information (n, 2, 2): inverse
    covariance of the shift for unit pixel noise, nuisance parameters eliminated. figures (n, 4):
    weighted residual sum of squares, weight sum, pixels, 1 if the fit is usable.
    """
    n = CORNER_PARAMETERS
    normal, right, frame = np.zeros((n, n)), np.zeros(n), np.zeros(6)
    factor = np.zeros((n, n))
    room = int(2 * half.max() + 4) ** 2 if len(half) else 0
    pixels, rows = np.zeros((3, room)), np.zeros((n, room))
    miss, weight = np.zeros(room), np.ones(room)
    for k in range(len(points)):
        m, p = maps[k], state[k]
        figures[k, :] = 0.0
        _corner_frame(m, frame)
        count = _gather_corner(image, points[k], half[k], m, frame, limits, pixels)
        if count < MIN_PIXELS:
            continue
        if not _start_corner(pixels, count, m, p):
            continue
        usable, improved = True, 0.0
        for step in range(iterations):
            for i in range(count):
                model = _corner_pixel(pixels[0, i], pixels[1, i], m, p, frame, rows, i)
                miss[i] = pixels[2, i] - model
                weight[i] = pixel_weight(miss[i], scale[k]) if step > 0 else 1.0
                if model >= limits[2] <= pixels[2, i]:
                    weight[i] = 0.0
            sum_up(rows, miss, weight, count, normal, right)
            usable, improved, moved_px = advance(normal, right, factor, p)
            if not usable or (step > 0 and moved_px < SETTLED_PX):
                break
            p[8] = min(max(p[8], 0.35), 6.0)
            if abs(p[0]) + abs(p[1]) > 0.5 * half[k]:
                usable = False
                break
        figures[k, 0] = -improved  # by the last step, which was not evaluated any more
        for i in range(count):
            figures[k, 0] += weight[i] * miss[i] * miss[i]
            figures[k, 1] += weight[i]
        figures[k, 2] = count
        if usable:
            usable = reduce_to_shift(normal, information[k])
        figures[k, 3] = 1.0 if usable else 0.0
