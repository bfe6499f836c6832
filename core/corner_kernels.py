"""Compiled loops over pixels: the grey-value model of a checkerboard corner.

The loop that costs is in single precision, without branches and without stores, so that it runs
on vector units: eight pixels take as long as one. What its rounding adds is below 1e-5 px.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from core.frames import PixelArray
from core.pixel_fit import MIN_PIXELS, compiled, solve_spd
from core.site import FloatArray

CORNER_PARAMETERS = 9
GAIN, BLUR, SHIFT = 3, 6, 7
"""Where a corner's parameters hold the gain, the blur and (two) the shift.

The order is offset and its slopes by u and v, gain and its slopes, blur, shift. The shift is last
so that the Cholesky factor of the normal matrix ends with the information on the shift.
"""
BOX = 4
"""Side, px, of the boxes whose means stand for the flat parts of the squares."""
_LANES = 16
_SETTLED_PX = 0.01
"""After such a step the next one would be a hundred times smaller."""
_SCALARS = 25

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
_FAR = np.float32(3.5)
# erf(z / sqrt 2) / z and its derivative by z as polynomials of z^2 up to _FAR, by least squares;
# right to 5e-5 and 2e-3. Both are even, so that what they lack shifts nothing.
_E = (0.797603084, -0.132069732, 0.019075051, -0.00199318357, 1.39718096e-4, -5.77346843e-6)
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(c) for c in (*_E, 1.04686249e-7))
_B = (0.795552579, -0.383966197, 0.0835333061, -0.00976436898, 5.88163679e-4, -1.42182613e-5)
_B0, _B1, _B2, _B3, _B4, _B5 = (np.float32(c) for c in _B)


@compiled
def _edge(distance: Any, per_blur: Any) -> tuple[Any, Any, Any]:
    """Edge profile erf(z / sqrt 2), its derivative by z, and z, the distance in blur widths."""
    z = min(max(distance * per_blur, -_FAR), _FAR)
    t = z * z
    rise = z * (_E0 + t * (_E1 + t * (_E2 + t * (_E3 + t * (_E4 + t * (_E5 + t * _E6))))))
    bell = _B0 + t * (_B1 + t * (_B2 + t * (_B3 + t * (_B4 + t * _B5))))
    return rise, bell, z


@compiled
def _sum_up(
    samples: FloatArray, count: int, c: FloatArray, normal: FloatArray, right: FloatArray
) -> tuple[float, float]:
    """Weighted normal equations (lower half) of samples (u, v, grey, pixels).

    Gives the weighted sum of squares, and how many samples that is, faded ones counted in part.

    The model is offset + gain * edge(x) * edge(y), offset and gain linear in (u, v), x and y the
    distances in px from the edges, polynomials of (u, v) less the shift. c: see `_pack`.
    """
    x_u, x_v, x_uu, x_uv, x_vv = c[0], c[1], c[2], c[3], c[4]
    y_u, y_v, y_uu, y_uv, y_vv = c[5], c[6], c[7], c[8], c[9]
    offset, offset_u, offset_v, gain, gain_u, gain_v = c[10], c[11], c[12], c[13], c[14], c[15]
    per_blur, shift_u, shift_v, fading, saturation = c[16], c[17], c[18], c[19], c[20]
    us, vs, greys, pixels = samples[0], samples[1], samples[2], samples[3]
    n1 = nu = nv = nuu = nuv = nvv = _ZERO  # w (1 u v)^2, with s = edge(x) * edge(y):
    s1 = su = sv = suu = suv = svv = _ZERO  # w s (1 u v)^2
    q1 = qu = qv = quu = quv = qvv = _ZERO  # w s^2 (1 u v)^2
    b1 = bu = bv = bs = bsu = bsv = bb = _ZERO  # w by_blur (1 u v s su sv by_blur)
    h1 = hu = hv = hs = hsu = hsv = hb = hh = _ZERO  # w by_shift_u (... by_shift_u)
    k1 = ku = kv = ks = ksu = ksv = kb = kh = kk = _ZERO  # w by_shift_v (... by_shift_v)
    m1 = mu = mv = ms = msu = msv = mb = mh = mk = mm = _ZERO  # w miss (... miss)
    told = _ZERO
    for i in range(count):
        u, v = us[i], vs[i]
        du, dv = u - shift_u, v - shift_v
        x = du * (x_u + x_uu * du + x_uv * dv) + dv * (x_v + x_vv * dv)
        y = du * (y_u + y_uu * du + y_uv * dv) + dv * (y_v + y_vv * dv)
        rise_x, bell_x, z_x = _edge(x, per_blur)
        rise_y, bell_y, z_y = _edge(y, per_blur)
        local = gain + gain_u * u + gain_v * v
        s = rise_x * rise_y
        model = offset + offset_u * u + offset_v * v + local * s
        miss = greys[i] - model
        local *= -per_blur
        by_x, by_y = local * rise_y * bell_x, local * rise_x * bell_y
        by_u, by_v = by_x * c[21] + by_y * c[23], by_x * c[22] + by_y * c[24]
        by_blur = by_x * z_x + by_y * z_y
        # Full weight within 3 times the scale, fading as Geman-McClure beyond.
        beyond = max(fading * miss * miss, _ONE)
        faded = _ONE / (beyond * beyond)
        faded = _ZERO if model >= saturation and greys[i] >= saturation else faded
        w = pixels[i] * faded
        told += min(pixels[i], faded)
        wu, wv, ws = w * u, w * v, w * s
        s_u, s_v, ws_u, ws_v = s * u, s * v, ws * u, ws * v
        n1, nu, nv = n1 + w, nu + wu, nv + wv
        nuu, nuv, nvv = nuu + wu * u, nuv + wu * v, nvv + wv * v
        s1, su, sv = s1 + ws, su + ws_u, sv + ws_v
        suu, suv, svv = suu + ws_u * u, suv + ws_u * v, svv + ws_v * v
        q1, qu, qv = q1 + ws * s, qu + ws_u * s, qv + ws_v * s
        quu, quv, qvv = quu + ws_u * s_u, quv + ws_u * s_v, qvv + ws_v * s_v
        wb = w * by_blur
        b1, bu, bv, bs = b1 + wb, bu + wb * u, bv + wb * v, bs + wb * s
        bsu, bsv, bb = bsu + wb * s_u, bsv + wb * s_v, bb + wb * by_blur
        wh = w * by_u
        h1, hu, hv, hs = h1 + wh, hu + wh * u, hv + wh * v, hs + wh * s
        hsu, hsv, hb, hh = hsu + wh * s_u, hsv + wh * s_v, hb + wh * by_blur, hh + wh * by_u
        wk = w * by_v
        k1, ku, kv, ks = k1 + wk, ku + wk * u, kv + wk * v, ks + wk * s
        ksu, ksv, kb, kh = ksu + wk * s_u, ksv + wk * s_v, kb + wk * by_blur, kh + wk * by_u
        kk += wk * by_v
        wm = w * miss
        m1, mu, mv, ms = m1 + wm, mu + wm * u, mv + wm * v, ms + wm * s
        msu, msv, mb, mh = msu + wm * s_u, msv + wm * s_v, mb + wm * by_blur, mh + wm * by_u
        mk, mm = mk + wm * by_v, mm + wm * miss
    _place(normal, 0, (n1, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO))
    _place(normal, 1, (nu, nuu, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO))
    _place(normal, 2, (nv, nuv, nvv, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO))
    _place(normal, 3, (s1, su, sv, q1, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO))
    _place(normal, 4, (su, suu, suv, qu, quu, _ZERO, _ZERO, _ZERO, _ZERO))
    _place(normal, 5, (sv, suv, svv, qv, quv, qvv, _ZERO, _ZERO, _ZERO))
    _place(normal, 6, (b1, bu, bv, bs, bsu, bsv, bb, _ZERO, _ZERO))
    _place(normal, 7, (h1, hu, hv, hs, hsu, hsv, hb, hh, _ZERO))
    _place(normal, 8, (k1, ku, kv, ks, ksu, ksv, kb, kh, kk))
    right[0], right[1], right[2], right[3], right[4] = m1, mu, mv, ms, msu
    right[5], right[6], right[7], right[8] = msv, mb, mh, mk
    return float(mm), float(told)


@compiled
def _place(normal: FloatArray, row: int, values: tuple[Any, ...]) -> None:
    for column in range(CORNER_PARAMETERS):
        normal[row, column] = values[column]


@compiled
def _edges_in_px(m: FloatArray, c: FloatArray) -> None:
    """Put the map m (2, 5), in squares, into c[:10] in px, and its slopes in px into c[21:25]."""
    for axis in range(2):
        px = 1.0 / math.sqrt(m[axis, 0] * m[axis, 0] + m[axis, 1] * m[axis, 1])
        for term in range(5):
            c[5 * axis + term] = m[axis, term] * px
        c[21 + 2 * axis], c[22 + 2 * axis] = m[axis, 0] * px, m[axis, 1] * px


@compiled
def _pack(p: FloatArray, scale: float, saturation: float, c: FloatArray) -> None:
    """Put parameters, pixel weights (scale 0: none) and saturation into c[10:21]."""
    for k in range(CORNER_PARAMETERS):
        c[10 + k] = p[k]
    c[16] = 1.0 / p[BLUR]
    c[19] = 1.0 / (9.0 * scale * scale) if scale > 0.0 else 0.0
    c[20] = saturation


@compiled
def _between(slope: float, at: float, reach: float) -> tuple[float, float]:
    """Give the interval of u in which |slope u + at| <= reach."""
    if abs(slope) < 1e-6:
        return (-1e6, 1e6) if abs(at) <= reach else (1e6, -1e6)
    middle, half = -at / slope, reach / abs(slope)
    return middle - half, middle + half


@compiled
def _copy_run(
    image: PixelArray, at: FloatArray, row: int, first: int, last: int,
    samples: FloatArray, count: int,
) -> int:  # fmt: skip
    """Append the pixels of a row from column `first` to `last`; gives how many there are now."""
    first, last = max(first, 0), min(last, image.shape[1] - 1)
    last = min(last, first + samples.shape[1] - _LANES - count - 1)
    number = max(last - first + 1, 0)
    for i in range(number):
        samples[0, count + i] = np.float32(first + i - at[0])
        samples[1, count + i] = np.float32(row - at[1])
        samples[2, count + i] = np.float32(image[row, first + i])
        samples[3, count + i] = _ONE
    return count + number


@compiled
def _gather_edges(
    image: PixelArray, at: FloatArray, half: float, c: FloatArray, limits: FloatArray,
    samples: FloatArray,
) -> int:  # fmt: skip
    """Collect the pixels near a corner's edges and not nearer to the next corner's."""
    count = 0
    reach_x, reach_y = limits[0] / limits[4], limits[0] / limits[5]
    band = limits[1]
    for row in range(
        max(0, math.ceil(at[1] - half)), min(image.shape[0] - 1, math.floor(at[1] + half)) + 1
    ):
        v = row - at[1]
        x_low, x_high = _between(c[0], c[1] * v, reach_x)
        y_low, y_high = _between(c[5], c[6] * v, reach_y)
        low, high = max(x_low, y_low, -half), min(x_high, y_high, half)
        a_low, a_high = _between(c[0], c[1] * v, band)
        b_low, b_high = _between(c[5], c[6] * v, band)
        if b_low < a_low:
            a_low, a_high, b_low, b_high = b_low, b_high, a_low, a_high
        first = math.ceil(at[0] + max(a_low, low))
        last = math.floor(at[0] + min(a_high, high))
        count = _copy_run(image, at, row, first, last, samples, count)
        again = max(math.ceil(at[0] + max(b_low, low)), last + 1 if last >= first else first)
        last = math.floor(at[0] + min(b_high, high))
        count = _copy_run(image, at, row, again, last, samples, count)
    return count


@compiled
def _gather_flats(
    boxes: FloatArray, at: FloatArray, half: float, c: FloatArray, limits: FloatArray,
    samples: FloatArray, count: int,
) -> int:  # fmt: skip
    """Append the means of boxes that lie in the squares, off the edges, and are not saturated."""
    reach_x, reach_y = limits[0] / limits[4], limits[0] / limits[5]
    gap, full = limits[2], 0.99 * limits[3]
    middle = 0.5 * (BOX - 1)
    first_u = max(0, math.ceil((at[0] - half - middle) / BOX))
    last_u = min(boxes.shape[1] - 1, math.floor((at[0] + half - middle) / BOX))
    first_v = max(0, math.ceil((at[1] - half - middle) / BOX))
    last_v = min(boxes.shape[0] - 1, math.floor((at[1] + half - middle) / BOX))
    for row in range(first_v, last_v + 1):
        v = BOX * row + middle - at[1]
        for column in range(first_u, last_u + 1):
            u = BOX * column + middle - at[0]
            x, y = abs(c[0] * u + c[1] * v), abs(c[5] * u + c[6] * v)
            if x < gap or y < gap or x > reach_x or y > reach_y or boxes[row, column] > full:
                continue
            samples[0, count], samples[1, count] = u, v
            samples[2, count], samples[3, count] = boxes[row, column], BOX * BOX
            count += 1
    return count


@compiled
def _start(samples: FloatArray, count: int, c: FloatArray, p: FloatArray) -> bool:
    """Start offset and gain from the mean of the bright and of the dark squares."""
    same = other = n_same = n_other = _ZERO
    for i in range(count):
        u, v, n = samples[0, i], samples[1, i], samples[3, i]
        alike = (c[0] * u + c[1] * v) * (c[5] * u + c[6] * v) > _ZERO
        here = n if alike else _ZERO
        there = n - here
        same, other = same + here * samples[2, i], other + there * samples[2, i]
        n_same, n_other = n_same + here, n_other + there
    if n_same < 8.0 or n_other < 8.0:
        return False
    same, other = same / n_same, other / n_other
    p[:] = 0.0
    p[0], p[GAIN] = 0.5 * (same + other), 0.5 * (same - other)
    return True


@compiled
def fit_corners(
    image: PixelArray, boxes: FloatArray, points: FloatArray, maps: FloatArray,
    half: FloatArray, scale: float, limits: FloatArray, blur: float, iterations: int,
    state: FloatArray, information: FloatArray, figures: FloatArray,
) -> None:  # fmt: skip
    """Fit the corner model at each predicted point by Gauss-Newton, in at most `iterations` steps.

    image (h, w) DN; boxes (h // BOX, w // BOX) means of its boxes, or (0, 0) to do without;
    points (n, 2) px; maps (n, 2, 5) squares per px, px^2; half (n,) px; scale DN: noise for the
    pixel weights, 0 for none; limits: reach in squares, band about the edges px, gap between
    edges and boxes px, saturation DN; blur px to start from.
    Out: state (n, 9); information (n, 2, 2), the inverse covariance of the shift for unit pixel
    noise, nuisance parameters eliminated; figures (n, 3): weighted sum of squares, samples, 1 if
    the fit is usable.
    """
    n = CORNER_PARAMETERS
    normal, factor, right, step = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n), np.zeros(n)
    room = int(2 * half.max() + 4) ** 2 + _LANES if len(half) else _LANES
    samples, c = np.zeros((4, room), np.float32), np.zeros(_SCALARS, np.float32)
    bounds = np.zeros(6)
    bounds[:4] = limits
    for k in range(len(points)):
        m, p = maps[k], state[k]
        figures[k, :] = 0.0
        _edges_in_px(m, c)
        bounds[4] = math.sqrt(m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1])
        bounds[5] = math.sqrt(m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1])
        count = _gather_edges(image, points[k], half[k], c, bounds, samples)
        if count < MIN_PIXELS:
            continue
        count = _gather_flats(boxes, points[k], half[k], c, bounds, samples, count)
        if not _start(samples, count, c, p):
            continue
        p[BLUR] = blur
        padded = (count + _LANES - 1) // _LANES * _LANES
        samples[:, count:padded] = 0.0
        usable, squares, told = True, 0.0, 0.0
        for turn in range(iterations):
            _pack(p, scale if turn > 0 else 0.0, limits[3], c)
            squares, told = _sum_up(samples, padded, c, normal, right)
            factor[:, :] = normal
            step[:] = right
            usable = solve_spd(factor, step, n)
            if not usable:
                break
            gain = p[GAIN]
            for a in range(n):
                p[a] += step[a]
                squares -= step[a] * right[a]  # the sum after the step, which is not evaluated
            if turn == 0 and abs(p[GAIN]) > 0.3 * abs(gain):
                # The first step was found with a gain that was only guessed.
                p[SHIFT] *= gain / p[GAIN]
                p[SHIFT + 1] *= gain / p[GAIN]
            moved_px = abs(step[SHIFT]) + abs(step[SHIFT + 1])
            if turn > 0 and moved_px < _SETTLED_PX:
                break
            p[BLUR] = min(max(p[BLUR], 0.35), 6.0)
            if abs(p[SHIFT]) + abs(p[SHIFT + 1]) > 0.5 * half[k]:
                usable = False
                break
        figures[k, 0], figures[k, 1] = squares, told
        if usable:
            _information(factor, information[k])
            figures[k, 2] = 1.0


@compiled
def _information(factor: FloatArray, information: FloatArray) -> None:
    """What the last two rows of a Cholesky factor say: the Schur complement of all others."""
    a, b, d = factor[SHIFT, SHIFT], factor[SHIFT + 1, SHIFT], factor[SHIFT + 1, SHIFT + 1]
    information[0, 0], information[1, 1] = a * a, b * b + d * d
    information[0, 1] = information[1, 0] = a * b


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
