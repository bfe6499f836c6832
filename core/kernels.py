"""Compiled loops over pixels: the grey-value models of a checkerboard corner and of a disc.

Both kernels do Gauss-Newton steps with analytic derivatives and pixel weights that fade out
what the model cannot explain (dust, an insect). They are plain loops because NumPy would write
some twenty arrays of a million pixels for every step.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.site import FloatArray, IntArray

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
_SETTLED_PX = 0.003  # the next step would be a hundred times smaller
_FAR = 3.8  # beyond this many blur widths an edge is flat to 1e-4 of its contrast


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
    """Edge profile erf(d / (sqrt 2 s)) and its derivatives by d and s."""
    z = distance / blur
    if z > _FAR:
        return 1.0, 0.0, 0.0
    if z < -_FAR:
        return -1.0, 0.0, 0.0
    bell = 0.7978845608028654 / blur * math.exp(-0.5 * z * z)
    return math.erf(z * 0.7071067811865476), bell, -bell * z


@_fast
def _corner_pixel(
    du: float, dv: float, m: FloatArray, p: FloatArray, limits: FloatArray, row: FloatArray
) -> tuple[bool, float]:
    """Model grey value of one pixel and its derivatives (into `row`).

    m (2, 5): the board's coordinates about the corner, in squares, as polynomials of the
    pixel's offset; p: shift u, v, offset and its slopes, gain and its slopes, blur.
    limits: reach in squares, band in px. False where the pixel belongs to a neighbouring corner
    or is too far from both edges to tell anything.
    """
    reach, band = limits[0], limits[1]
    u, v = du - p[0], dv - p[1]
    x = m[0, 0] * u + m[0, 1] * v + m[0, 2] * u * u + m[0, 3] * u * v + m[0, 4] * v * v
    y = m[1, 0] * u + m[1, 1] * v + m[1, 2] * u * u + m[1, 3] * u * v + m[1, 4] * v * v
    if abs(x) > reach or abs(y) > reach:
        return False, 0.0
    xu, xv = m[0, 0] + 2 * m[0, 2] * u + m[0, 3] * v, m[0, 1] + m[0, 3] * u + 2 * m[0, 4] * v
    yu, yv = m[1, 0] + 2 * m[1, 2] * u + m[1, 3] * v, m[1, 1] + m[1, 3] * u + 2 * m[1, 4] * v
    nx, ny = 1.0 / math.sqrt(xu * xu + xv * xv), 1.0 / math.sqrt(yu * yu + yv * yv)
    if abs(x) * nx > band and abs(y) * ny > band:
        return False, 0.0
    ex, ex_d, ex_s = _edge(x * nx, p[8])
    ey, ey_d, ey_s = _edge(y * ny, p[8])
    gain = p[5] + p[6] * du + p[7] * dv
    sign = ex * ey
    by_x, by_y = gain * ey * ex_d * nx, gain * ex * ey_d * ny
    row[0] = -(by_x * xu + by_y * yu)
    row[1] = -(by_x * xv + by_y * yv)
    row[2], row[3], row[4] = 1.0, du, dv
    row[5], row[6], row[7] = sign, sign * du, sign * dv
    row[8] = gain * (ey * ex_s + ex * ey_s)
    return True, p[2] + p[3] * du + p[4] * dv + gain * sign


@_fast
def _accumulate(
    normal: FloatArray, right: FloatArray, row: FloatArray, miss: float, weight: float
) -> None:
    """Add one pixel to the normal equations (lower half)."""
    for a in range(len(row)):
        scaled = weight * row[a]
        right[a] += scaled * miss
        for b in range(a + 1):
            normal[a, b] += scaled * row[b]


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
def _start_corner(
    image: FloatArray, box: IntArray, at: FloatArray, m: FloatArray, reach: float, p: FloatArray
) -> bool:
    """Start offset and gain from the mean of the bright and of the dark squares."""
    total, count = np.zeros(2), np.zeros(2)
    for v in range(box[1], box[3]):
        for u in range(box[0], box[2]):
            du, dv = u - at[0], v - at[1]
            x, y = m[0, 0] * du + m[0, 1] * dv, m[1, 0] * du + m[1, 1] * dv
            if abs(x) > reach or abs(y) > reach:
                continue
            side = 1 if x * y > 0 else 0
            total[side] += image[v, u]
            count[side] += 1.0
    if count[0] < 8 or count[1] < 8:
        return False
    same, other = total[1] / count[1], total[0] / count[0]
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
    edges in px, saturation DN. At most `iterations` steps; a last pass evaluates the fit.
    state (n, 9) in and out: started afresh where the blur is 0. information (n, 2, 2): inverse
    covariance of the shift for unit pixel noise, nuisance parameters eliminated. figures (n, 4):
    weighted residual sum of squares, weight sum, pixels, 1 if the fit is usable.
    """
    n = CORNER_PARAMETERS
    row, normal, right = np.zeros(n), np.zeros((n, n)), np.zeros(n)
    box = np.zeros(4, np.int64)
    height, width = image.shape
    for k in range(len(points)):
        at, m, p = points[k], maps[k], state[k]
        figures[k, :] = 0.0
        box[0] = max(0, math.floor(at[0] - half[k]))
        box[1] = max(0, math.floor(at[1] - half[k]))
        box[2] = min(width, math.ceil(at[0] + half[k]) + 1)
        box[3] = min(height, math.ceil(at[1] + half[k]) + 1)
        if p[8] == 0.0:
            p[:] = 0.0
            p[8] = 1.0
            if not _start_corner(image, box, at, m, limits[0], p):
                continue
        usable, settled = True, False
        for step in range(iterations + 1):
            normal[:, :] = 0.0
            right[:] = 0.0
            residual, weights, pixels = 0.0, 0.0, 0.0
            for v in range(box[1], box[3]):
                for u in range(box[0], box[2]):
                    grey = image[v, u]
                    if grey >= limits[2]:
                        continue
                    inside, model = _corner_pixel(u - at[0], v - at[1], m, p, limits, row)
                    if not inside:
                        continue
                    miss = grey - model
                    weight = _pixel_weight(miss, scale[k]) if step > 0 else 1.0
                    _accumulate(normal, right, row, miss, weight)
                    residual += weight * miss * miss
                    weights += weight
                    pixels += 1.0
            figures[k, 0], figures[k, 1], figures[k, 2] = residual, weights, pixels
            if pixels < 40.0:
                usable = False
                break
            if step == iterations or settled:
                break
            if not solve_spd(normal, right, n):
                usable = False
                break
            for a in range(n):
                p[a] += right[a]
            settled = step > 0 and abs(right[0]) + abs(right[1]) < _SETTLED_PX
            p[8] = min(max(p[8], 0.35), 6.0)
            if abs(p[0]) + abs(p[1]) > 0.5 * half[k]:
                usable = False
                break
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
def _disc_pixel(du: float, dv: float, p: FloatArray, row: FloatArray) -> tuple[float, float]:
    """Model grey value of one pixel of a disc and its derivatives; also the distance outside.

    p: shift u, v, the symmetric matrix that takes the unit circle to the outline (a, b, c),
    offset and slopes, gain and slopes, blur.
    """
    u, v = du - p[0], dv - p[1]
    a, b, c = p[2], p[3], p[4]
    det = a * c - b * b
    qx, qy = (c * u - b * v) / det, (a * v - b * u) / det
    rho = math.sqrt(qx * qx + qy * qy) + 1e-9
    # grad rho = A^-T q / rho; the signed distance is (rho - 1) / |grad rho|.
    hx, hy = (c * qx - b * qy) / (det * rho), (a * qy - b * qx) / (det * rho)
    norm = math.sqrt(hx * hx + hy * hy) + 1e-12
    distance = (rho - 1.0) / norm
    edge, slope, by_blur = _edge(-distance, p[11])
    half = 0.5 * (1.0 + edge)
    gain = p[8] + p[9] * du + p[10] * dv
    # d(distance) = -(h . dx) / norm for a shift, -(h . dA q) / norm for the outline.
    by_distance = 0.5 * gain * slope / norm
    row[0], row[1] = by_distance * hx, by_distance * hy
    row[2], row[3], row[4] = (
        by_distance * hx * qx,
        by_distance * (hx * qy + hy * qx),
        by_distance * hy * qy,
    )
    row[5], row[6], row[7] = 1.0, du, dv
    row[8], row[9], row[10] = half, half * du, half * dv
    row[11] = 0.5 * gain * by_blur
    return p[5] + p[6] * du + p[7] * dv + gain * half, distance


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

    image (h, w) DN; points (n, 2) px; limits: reach beyond the outline px, saturation DN;
    scale: DN noise for the pixel weights, 0 for none. state (n, 12) in and out; information
    (n, 2, 2) as in `fit_corners`; figures (n, 5): weighted residual sum of squares, weight sum,
    pixels near the outline, pixels there with weight above a half, 1 if usable.
    """
    n = DISC_PARAMETERS
    row, normal, right = np.zeros(n), np.zeros((n, n)), np.zeros(n)
    height, width = image.shape
    for k in range(len(points)):
        at, p = points[k], state[k]
        figures[k, :] = 0.0
        usable = True
        for step in range(iterations + 1):
            normal[:, :] = 0.0
            right[:] = 0.0
            residual, weights, near, kept = 0.0, 0.0, 0.0, 0.0
            radius = max(p[2], p[4]) + abs(p[3]) + limits[0]
            for v in range(
                max(0, int(at[1] + p[1] - radius)), min(height, int(at[1] + p[1] + radius) + 2)
            ):
                for u in range(
                    max(0, int(at[0] + p[0] - radius)), min(width, int(at[0] + p[0] + radius) + 2)
                ):
                    grey = image[v, u]
                    if grey >= limits[1]:
                        continue
                    model, distance = _disc_pixel(u - at[0], v - at[1], p, row)
                    if abs(distance) > limits[0]:
                        continue
                    miss = grey - model
                    weight = _pixel_weight(miss, scale) if step > 0 else 1.0
                    _accumulate(normal, right, row, miss, weight)
                    residual += weight * miss * miss
                    weights += weight
                    near += 1.0
                    if weight > 0.5:
                        kept += 1.0
            figures[k, 0], figures[k, 1], figures[k, 2], figures[k, 3] = (
                residual,
                weights,
                near,
                kept,
            )
            if near < 24.0:
                usable = False
                break
            if step == iterations:
                break
            if not solve_spd(normal, right, n):
                usable = False
                break
            for a in range(n):
                p[a] += right[a]
            p[11] = min(max(p[11], 0.35), 12.0)
            if not (p[2] > 1.0 and p[4] > 1.0 and p[2] * p[4] > p[3] * p[3]):
                usable = False
                break
            if abs(p[0]) + abs(p[1]) > max(p[2], p[4]):
                usable = False
                break
        if usable:
            usable = _reduce(normal, information[k])
        figures[k, 4] = 1.0 if usable else 0.0
