"""Compiled loops over pixels: the grey-value models of a checkerboard corner and of a disc.

A saturated pixel says only that the light was at least so bright: where the model is brighter
still it has no weight. Both kernels do Gauss-Newton steps with analytic derivatives and pixel
weights that fade out what the model cannot explain (dust, an insect). They are plain loops
because NumPy would write some twenty arrays of a million pixels for every step.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.special import erf

from core.site import FloatArray

# Sums may be reordered (so that they run on vector units), but NaN and infinity stay exact.
_fast = njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    boundscheck=False,
    fastmath={"contract", "reassoc", "nsz", "arcp"},
)

CORNER_PARAMETERS = 9
DISC_PARAMETERS = 12
_MIN_PIXELS = 40
_SETTLED_PX = 0.003  # the next step would be a hundred times smaller
_FAR = 4.0  # beyond this many blur widths an edge is flat to 1e-4 of its contrast
_NODES_PER_WIDTH = 32.0
_NODES = np.arange(int(2 * _FAR * _NODES_PER_WIDTH) + 2) / _NODES_PER_WIDTH - _FAR
_PROFILE = erf(_NODES / math.sqrt(2.0))
_BELL = math.sqrt(2.0 / math.pi) * np.exp(-0.5 * _NODES**2)


@_fast
def solve_spd(matrix: FloatArray, vector: FloatArray, n: int) -> bool:
    """Solve in place by Cholesky; `vector` becomes the solution; False if not positive."""
    for j in range(n):
        total = matrix[j, j]
        for k in range(j):
            total -= matrix[j, k] * matrix[j, k]
        if not total > 1e-12 * abs(matrix[j, j]) or total <= 0.0:
            return False
        pivot = math.sqrt(total)
        matrix[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / pivot
    _substitute(matrix, vector, n)
    return True


@_fast
def _substitute(factor: FloatArray, vector: FloatArray, n: int) -> None:
    for i in range(n):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * vector[k]
        vector[i] = total / factor[i, i]


@_fast
def _edge(distance: float, blur: float) -> tuple[float, float, float]:
    """Edge profile erf(d / (sqrt 2 s)) and its derivatives by d and s.

    Between the nodes of a table by its own derivatives (cubic Hermite), right to 1e-9.
    """
    z = distance / blur
    if z > _FAR:
        return 1.0, 0.0, 0.0
    if z < -_FAR:
        return -1.0, 0.0, 0.0
    at = (z + _FAR) * _NODES_PER_WIDTH
    node = int(at)
    t = at - node
    step = 1.0 / _NODES_PER_WIDTH
    here, there = _PROFILE[node], _PROFILE[node + 1]
    slope_here, slope_there = _BELL[node] * step, _BELL[node + 1] * step
    rise = there - here
    bend = 3.0 * rise - 2.0 * slope_here - slope_there
    twist = slope_here + slope_there - 2.0 * rise
    value = here + t * (slope_here + t * (bend + t * twist))
    bell = (slope_here + t * (2.0 * bend + 3.0 * t * twist)) * _NODES_PER_WIDTH / blur
    return value, bell, -bell * z


@_fast
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
    ex, ex_d, ex_s = _edge(x * frame[0], p[8])
    ey, ey_d, ey_s = _edge(y * frame[1], p[8])
    gain = p[5] + p[6] * u + p[7] * v
    sign = ex * ey
    by_x, by_y = gain * ey * ex_d, gain * ex * ey_d
    rows[0, at] = -(by_x * frame[2] + by_y * frame[4])
    rows[1, at] = -(by_x * frame[3] + by_y * frame[5])
    rows[2, at], rows[3, at], rows[4, at] = 1.0, u, v
    rows[5, at], rows[6, at], rows[7, at] = sign, sign * u, sign * v
    rows[8, at] = gain * (ey * ex_s + ex * ey_s)
    return float(p[2] + p[3] * u + p[4] * v + gain * sign)


@_fast
def _corner_frame(m: FloatArray, frame: FloatArray) -> None:
    """Px per square along x and y, and the slopes of m's linear part in units of those."""
    px_x = 1.0 / math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1])
    px_y = 1.0 / math.sqrt(m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1])
    frame[0], frame[1] = px_x, px_y
    frame[2], frame[3] = m[0, 0] * px_x, m[0, 1] * px_x
    frame[4], frame[5] = m[1, 0] * px_y, m[1, 1] * px_y


@_fast
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


@_fast
def _sum_up(
    rows: FloatArray,
    miss: FloatArray,
    weight: FloatArray,
    count: int,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Weighted normal equations (lower half) of `count` pixels, one dot product an element."""
    for a in range(len(right)):
        total = 0.0
        for i in range(count):
            total += weight[i] * rows[a, i] * miss[i]
        right[a] = total
        for b in range(a + 1):
            total = 0.0
            for i in range(count):
                total += weight[i] * rows[a, i] * rows[b, i]
            normal[a, b] = total


@_fast
def _advance(
    normal: FloatArray, right: FloatArray, factor: FloatArray, p: FloatArray
) -> tuple[bool, float, float]:
    """Take a Gauss-Newton step of the parameters p.

    Gives whether the normal matrix is positive, by how much the sum of squares falls, and how
    far the first two parameters, a shift in px, went. factor is room to work in.
    """
    factor[:, :] = normal
    step = right.copy()
    if not solve_spd(factor, step, len(p)):
        return False, 0.0, 0.0
    improved = 0.0
    for a in range(len(p)):
        p[a] += step[a]
        improved += right[a] * step[a]
    return True, improved, abs(step[0]) + abs(step[1])


@_fast
def _pixel_weight(miss: float, scale: float) -> float:
    """Full weight within 3 scale, fading as Geman-McClure beyond; 1 when scale is 0."""
    if scale <= 0.0:
        return 1.0
    z = abs(miss) / (3.0 * scale)
    if z <= 1.0:
        return 1.0
    return 1.0 / (z * z * z * z)


@_fast
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


@_fast
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
        if count < _MIN_PIXELS:
            continue
        if not _start_corner(pixels, count, m, p):
            continue
        usable, improved = True, 0.0
        for step in range(iterations):
            for i in range(count):
                model = _corner_pixel(pixels[0, i], pixels[1, i], m, p, frame, rows, i)
                miss[i] = pixels[2, i] - model
                weight[i] = _pixel_weight(miss[i], scale[k]) if step > 0 else 1.0
                if model >= limits[2] <= pixels[2, i]:
                    weight[i] = 0.0
            _sum_up(rows, miss, weight, count, normal, right)
            usable, improved, moved_px = _advance(normal, right, factor, p)
            if not usable or (step > 0 and moved_px < _SETTLED_PX):
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
            usable = _reduce(normal, information[k])
        figures[k, 3] = 1.0 if usable else 0.0


@_fast
def _reduce(normal: FloatArray, information: FloatArray) -> bool:
    """Schur complement of the first two parameters in a lower normal matrix."""
    n = normal.shape[0]
    rest = np.zeros((n - 2, n - 2))
    for a in range(2, n):
        for b in range(2, a + 1):
            rest[a - 2, b - 2] = normal[a, b]
    information[0, 0], information[1, 0] = normal[0, 0], normal[1, 0]
    information[0, 1], information[1, 1] = normal[1, 0], normal[1, 1]
    for c in range(2):
        column = np.zeros(n - 2)
        for a in range(2, n):
            column[a - 2] = normal[a, c]
        factor = rest.copy()
        if not solve_spd(factor, column, n - 2):
            return False
        for d in range(2):
            for a in range(2, n):
                information[d, c] -= normal[a, d] * column[a - 2]
    return bool(information[0, 0] > 0.0 and information[1, 1] > 0.0)


@_fast
def _disc_distance(u: float, v: float, p: FloatArray) -> float:
    """Signed distance, px, of an offset outside a disc's outline (see `_disc_pixel`)."""
    a, b, c = p[2], p[3], p[4]
    det = a * c - b * b
    du, dv = u - p[0], v - p[1]
    qx, qy = (c * du - b * dv) / det, (a * dv - b * du) / det
    rho = math.sqrt(qx * qx + qy * qy) + 1e-9
    hx, hy = (c * qx - b * qy) / (det * rho), (a * qy - b * qx) / (det * rho)
    return (rho - 1.0) / (math.sqrt(hx * hx + hy * hy) + 1e-12)


@_fast
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
    edge, slope, by_blur = _edge((1.0 - rho) / norm, p[11])
    inside = 0.5 * (1.0 + edge)
    gain = p[8] + p[9] * u + p[10] * v
    by_x, by_y = 0.5 * gain * slope * hx / norm, 0.5 * gain * slope * hy / norm
    rows[0, at], rows[1, at] = by_x, by_y
    rows[2, at], rows[3, at], rows[4, at] = by_x * qx, by_x * qy + by_y * qx, by_y * qy
    rows[5, at], rows[6, at], rows[7, at] = 1.0, u, v
    rows[8, at], rows[9, at], rows[10, at] = inside, inside * u, inside * v
    rows[11, at] = 0.5 * gain * by_blur
    return float(p[5] + p[6] * u + p[7] * v + gain * inside)


@_fast
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


@_fast
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
        if count < _MIN_PIXELS:
            continue
        usable, improved = True, 0.0
        for step in range(iterations):
            for i in range(count):
                model = _disc_pixel(pixels[0, i], pixels[1, i], p, rows, i)
                miss[i] = pixels[2, i] - model
                weight[i] = _pixel_weight(miss[i], scale) if step > 0 else 1.0
                if model >= limits[1] <= pixels[2, i]:
                    weight[i] = 0.0
            _sum_up(rows, miss, weight, count, normal, right)
            usable, improved, moved_px = _advance(normal, right, factor, p)
            if not usable or (step > 1 and moved_px < _SETTLED_PX):
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
            usable = _reduce(normal, information[k])
        figures[k, 4] = 1.0 if usable else 0.0
