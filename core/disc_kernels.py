"""Compiled loops over pixels: the grey-value model of a bright disc."""

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

DISC_PARAMETERS = 12


@compiled
def _disc_distance(u: float, v: float, p: FloatArray) -> float:
    """Signed distance, px, of an offset outside a disc's outline (see `_disc_pixel`)."""
    a, b, c = p[2], p[3], p[4]
    det = a * c - b * b
    du, dv = u - p[0], v - p[1]
    qx, qy = (c * du - b * dv) / det, (a * dv - b * du) / det
    rho = math.sqrt(qx * qx + qy * qy) + 1e-9
    hx, hy = (c * qx - b * qy) / (det * rho), (a * qy - b * qx) / (det * rho)
    return (rho - 1.0) / (math.sqrt(hx * hx + hy * hy) + 1e-12)


@compiled
def _disc_pixel(u: float, v: float, p: FloatArray, rows: FloatArray, at: int) -> float:
    """Model grey value of one pixel of a disc; its derivatives go into rows[:, at].

    p: shift u, v, the symmetric matrix that takes the unit circle to the outline (a, b, c),
    offset and slopes, gain and slopes, blur. With q = A^-1 x, rho = |q| and h = grad rho the
    signed distance is (rho - 1) / |h|; it changes by -(h . dx) / |h| with a shift and by
    -(h . dA q) / |h| with the outline.
    """
    a, b, c = p[2], p[3], p[4]
    det = a * c - b * b
    du, dv = u - p[0], v - p[1]
    qx, qy = (c * du - b * dv) / det, (a * dv - b * du) / det
    rho = math.sqrt(qx * qx + qy * qy) + 1e-9
    hx, hy = (c * qx - b * qy) / (det * rho), (a * qy - b * qx) / (det * rho)
    norm = math.sqrt(hx * hx + hy * hy) + 1e-12
    rise, slope, by_blur = edge((1.0 - rho) / norm, p[11])
    inside = 0.5 * (1.0 + rise)
    gain = p[8] + p[9] * u + p[10] * v
    by_x, by_y = 0.5 * gain * slope * hx / norm, 0.5 * gain * slope * hy / norm
    rows[0, at], rows[1, at] = by_x, by_y
    rows[2, at], rows[3, at], rows[4, at] = by_x * qx, by_x * qy + by_y * qx, by_y * qy
    rows[5, at], rows[6, at], rows[7, at] = 1.0, u, v
    rows[8, at], rows[9, at], rows[10, at] = inside, inside * u, inside * v
    rows[11, at] = 0.5 * gain * by_blur
    return float(p[5] + p[6] * u + p[7] * v + gain * inside)


@compiled
def _gather_disc(
    image: FloatArray, at: FloatArray, p: FloatArray, limits: FloatArray, pixels: FloatArray
) -> int:
    """Collect (u, v, grey) of the pixels near a disc's outline; their number comes back."""
    count = 0
    radius = max(p[2], p[4]) + abs(p[3]) + limits[0]
    for row in range(
        max(0, int(at[1] + p[1] - radius)), min(image.shape[0], int(at[1] + p[1] + radius) + 2)
    ):
        for column in range(
            max(0, int(at[0] + p[0] - radius)), min(image.shape[1], int(at[0] + p[0] + radius) + 2)
        ):
            u, v = column - at[0], row - at[1]
            if abs(_disc_distance(u, v, p)) > limits[0]:
                continue
            if count == pixels.shape[1]:
                return count
            pixels[0, count], pixels[1, count], pixels[2, count] = u, v, image[row, column]
            count += 1
    return count


@compiled
def fit_discs(
    image: FloatArray,
    points: FloatArray,
    limits: FloatArray,
    scale: float,
    iterations: int,
    state: FloatArray,
    information: FloatArray,
    figures: FloatArray,
) -> None:
    """Fit a bright disc at each point.

    image (h, w) DN; points (n, 2) px; limits: reach about the outline px, saturation DN;
    scale: DN noise for the pixel weights, 0 for none. state (n, 12) in and out; information
    (n, 2, 2) as in `fit_corners`; figures (n, 5): weighted residual sum of squares, weight sum,
    pixels near the outline, pixels there with weight above a half, 1 if usable.
    """
    n = DISC_PARAMETERS
    normal, right = np.zeros((n, n)), np.zeros(n)
    factor = np.zeros((n, n))
    largest = 0.0
    for k in range(len(points)):
        largest = max(largest, max(state[k, 2], state[k, 4]) + abs(state[k, 3]))
    room = int(4.0 * math.pi * (largest + limits[0]) * (limits[0] + 1.0)) + 64
    pixels, rows = np.zeros((3, room)), np.zeros((n, room))
    miss, weight = np.zeros(room), np.ones(room)
    for k in range(len(points)):
        p = state[k]
        figures[k, :] = 0.0
        count = _gather_disc(image, points[k], p, limits, pixels)
        if count < MIN_PIXELS:
            continue
        usable, improved = True, 0.0
        for step in range(iterations):
            for i in range(count):
                model = _disc_pixel(pixels[0, i], pixels[1, i], p, rows, i)
                miss[i] = pixels[2, i] - model
                weight[i] = pixel_weight(miss[i], scale) if step > 0 else 1.0
                if model >= limits[1] <= pixels[2, i]:
                    weight[i] = 0.0
            sum_up(rows, miss, weight, count, normal, right)
            usable, improved, moved_px = advance(normal, right, factor, p)
            if not usable or (step > 1 and moved_px < SETTLED_PX):
                break
            p[11] = min(max(p[11], 0.35), 12.0)
            if not (p[2] > 1.0 and p[4] > 1.0 and p[2] * p[4] > p[3] * p[3]):
                usable = False
                break
            if abs(p[0]) + abs(p[1]) > max(p[2], p[4]):
                usable = False
                break
        figures[k, 0] = -improved  # by the last step, which was not evaluated any more
        for i in range(count):
            figures[k, 0] += weight[i] * miss[i] * miss[i]
            figures[k, 1] += weight[i]
            if weight[i] > 0.0:
                figures[k, 2] += 1.0
            if weight[i] > 0.5:
                figures[k, 3] += 1.0
        if usable:
            usable = reduce_to_shift(normal, information[k])
        figures[k, 4] = 1.0 if usable else 0.0
