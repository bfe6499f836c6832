"""Compiled sums over the pixels about a checkerboard's corner: its grey-value model.

The loops over pixels are in single precision, without branches and without stores, so that they
run on vector units: eight pixels take as long as one. Their rounding adds less than 1e-5 px.
How the compiler orders their sums depends on how they are written: rewriting a line here, even as
one that says the same, moves values by some 1e-7 mm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.compiled import inner_loop

CORNER_PARAMETERS = 9
"""Of the model with slopes of the light."""
GAIN, BLUR, SHIFT = 3, 6, 7
"""Where a corner's parameters hold the gain, the blur and (two) the shift.

The order is offset and its slopes by u and v, gain and its slopes, blur, shift. The shift is last
so that the Cholesky factor of the normal matrix ends with the information on the shift.
"""
EVEN_PARAMETERS = 5
"""Offset, gain, blur, shift: where the slopes are known."""
SCALARS = 32
"""How many scalars `c` the loops share for a corner:

c[0:5], c[5:10]: its two edges, the terms u, v, u^2, u v, v^2 of the distance from each, px;
c[10:16]: offset and its slopes by u and v, gain and its slopes, DN and DN/px;
c[16], c[30:32]: 1 / blur, 1/px, and its slopes by u and v; c[17:19]: the shift, px;
c[19]: 1 / 9 where pixels that miss by more than 3 sigma fade, 0 where all count in full;
c[20]: grey value of a saturated pixel, DN;
c[21:25]: d(distance)/d(u, v) of the first edge, then of the second;
c[25:29]: variance of a grey value: at 0, per DN, least and most, DN^2;
c[29]: what the model may miss by its own fault, DN^2.
"""

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
"""In single precision: a literal would turn the whole loop to double."""
_FAR = np.float32(3.5)
"""Blur widths from an edge beyond which the profile is taken as flat: to 2e-4 of the contrast."""
_FLAT = np.float32(2.5)
"""Blur widths from both edges beyond which a pixel shows the noise: the edge leaves 0.6 % of the
contrast there."""
# The profile erf(z / sqrt 2) over z as a polynomial of z^2, by least squares up to _FAR: the
# profile is right to 7e-5. It is odd, as the true one is, so that what it lacks shifts nothing.
_E = (0.797603084, -0.132069732, 0.019075051, -0.00199318357, 1.39718096e-4, -5.77346843e-6)
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(c) for c in (*_E, 1.04686249e-7))
# The derivative of erf(z / sqrt 2) by z, sqrt(2 / pi) exp(-z^2 / 2), likewise: right to 2.4e-3.
_B = (0.795552579, -0.383966197, 0.0835333061, -0.00976436898, 5.88163679e-4, -1.42182613e-5)
_B0, _B1, _B2, _B3, _B4, _B5 = (np.float32(c) for c in _B)


@inner_loop
def _edge(distance: Any, per_blur: Any) -> tuple[Any, Any, Any]:
    """Edge profile erf(z / sqrt 2), its derivative by z, and z, the distance in blur widths."""
    z = min(max(distance * per_blur, -_FAR), _FAR)
    t = z * z
    rise = z * (_E0 + t * (_E1 + t * (_E2 + t * (_E3 + t * (_E4 + t * (_E5 + t * _E6))))))
    bell = _B0 + t * (_B1 + t * (_B2 + t * (_B3 + t * (_B4 + t * _B5))))
    return rise, bell, z


@inner_loop
def accumulate(
    samples: FloatArray, count: int, c: FloatArray, normal: FloatArray, right: FloatArray
) -> tuple[float, float]:
    """Weighted normal equations (lower half) of samples (u, v, grey, pixels).

    Weights are inverse variances. Gives the weighted sum of squares, and how many samples that
    is, faded ones counted in part.

    The model is offset + gain * edge(x) * edge(y), offset and gain linear in (u, v), x and y the
    distances in px from the edges, polynomials of (u, v) less the shift. c: see SCALARS.
    """
    x_u, x_v, x_uu, x_uv, x_vv = c[0], c[1], c[2], c[3], c[4]
    y_u, y_v, y_uu, y_uv, y_vv = c[5], c[6], c[7], c[8], c[9]
    offset, offset_u, offset_v, gain, gain_u, gain_v = c[10], c[11], c[12], c[13], c[14], c[15]
    per_blur, shift_u, shift_v, fading, saturation = c[16], c[17], c[18], c[19], c[20]
    dark, by_grey, least, most, slack = c[25], c[26], c[27], c[28], c[29]
    sharp_u, sharp_v = c[30], c[31]
    us, vs, greys, pixels = samples[0], samples[1], samples[2], samples[3]
    n1 = nu = nv = nuu = nuv = nvv = _ZERO  # w (1 u v)^2, with s = edge(x) * edge(y):
    s1 = su = sv = suu = suv = svv = _ZERO  # w s (1 u v)^2
    q1 = qu = qv = quu = quv = qvv = _ZERO  # w s^2 (1 u v)^2
    b1 = bu = bv = bs = bsu = bsv = bb = _ZERO  # w by_blur (1 u v s su sv by_blur)
    h1 = hu = hv = hs = hsu = hsv = hb = hh = _ZERO  # w by_shift_u (... by_shift_u)
    k1 = ku = kv = ks = ksu = ksv = kb = kh = kk = _ZERO  # w by_shift_v (... by_shift_v)
    m1 = mu = mv = ms = msu = msv = mb = mh = mk = mm = _ZERO  # w miss (... miss)
    effective_count = _ZERO
    for i in range(count):
        u, v = us[i], vs[i]
        du, dv = u - shift_u, v - shift_v
        x = du * (x_u + x_uu * du + x_uv * dv) + dv * (x_v + x_vv * dv)
        y = du * (y_u + y_uu * du + y_uv * dv) + dv * (y_v + y_vv * dv)
        sharp = per_blur + sharp_u * u + sharp_v * v
        rise_x, bell_x, z_x = _edge(x, sharp)
        rise_y, bell_y, z_y = _edge(y, sharp)
        local = gain + gain_u * u + gain_v * v
        s = rise_x * rise_y
        model = offset + offset_u * u + offset_v * v + local * s
        miss = greys[i] - model
        local *= -sharp
        by_x, by_y = local * rise_y * bell_x, local * rise_x * bell_y
        by_u, by_v = by_x * c[21] + by_y * c[23], by_x * c[22] + by_y * c[24]
        by_blur = by_x * z_x + by_y * z_y
        variance = min(max(dark + by_grey * model, least), most)
        # Full weight within 3 sigma, beyond it that of Geman and McClure (1987).
        beyond = max(fading * miss * miss / (variance + slack), _ONE)
        faded = _ONE / (beyond * beyond)
        faded = _ZERO if model >= saturation and greys[i] >= saturation else faded
        w = pixels[i] * faded / variance
        effective_count += min(pixels[i], faded)
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
    return float(mm), float(effective_count)


@inner_loop
def accumulate_even(
    samples: FloatArray, count: int, c: FloatArray, normal: FloatArray, right: FloatArray
) -> float:
    """As `accumulate`, the slopes of offset and gain being known, every pixel counting in full.

    Fills (5, 5) and (5,) for offset, gain, blur and shift; gives the weighted sum of squares.
    """
    x_u, x_v, x_uu, x_uv, x_vv = c[0], c[1], c[2], c[3], c[4]
    y_u, y_v, y_uu, y_uv, y_vv = c[5], c[6], c[7], c[8], c[9]
    offset, offset_u, offset_v, gain, gain_u, gain_v = c[10], c[11], c[12], c[13], c[14], c[15]
    per_blur, shift_u, shift_v = c[16], c[17], c[18]
    dark, by_grey, least, most = c[25], c[26], c[27], c[28]
    sharp_u, sharp_v = c[30], c[31]
    us, vs, greys, pixels = samples[0], samples[1], samples[2], samples[3]
    n1 = s1 = q1 = b1 = bs = bb = h1 = hs = hb = hh = _ZERO
    k1 = ks = kb = kh = kk = m1 = ms = mb = mh = mk = mm = _ZERO
    for i in range(count):
        u, v = us[i], vs[i]
        du, dv = u - shift_u, v - shift_v
        x = du * (x_u + x_uu * du + x_uv * dv) + dv * (x_v + x_vv * dv)
        y = du * (y_u + y_uu * du + y_uv * dv) + dv * (y_v + y_vv * dv)
        sharp = per_blur + sharp_u * u + sharp_v * v
        rise_x, bell_x, z_x = _edge(x, sharp)
        rise_y, bell_y, z_y = _edge(y, sharp)
        local = gain + gain_u * u + gain_v * v
        s = rise_x * rise_y
        model = offset + offset_u * u + offset_v * v + local * s
        miss = greys[i] - model
        local *= -sharp
        by_x, by_y = local * rise_y * bell_x, local * rise_x * bell_y
        by_u, by_v = by_x * c[21] + by_y * c[23], by_x * c[22] + by_y * c[24]
        by_blur = by_x * z_x + by_y * z_y
        w = pixels[i] / min(max(dark + by_grey * model, least), most)
        ws, wb, wh, wk, wm = w * s, w * by_blur, w * by_u, w * by_v, w * miss
        n1, s1, q1 = n1 + w, s1 + ws, q1 + ws * s
        b1, bs, bb = b1 + wb, bs + wb * s, bb + wb * by_blur
        h1, hs, hb, hh = h1 + wh, hs + wh * s, hb + wh * by_blur, hh + wh * by_u
        k1, ks, kb = k1 + wk, ks + wk * s, kb + wk * by_blur
        kh, kk = kh + wk * by_u, kk + wk * by_v
        m1, ms, mb = m1 + wm, ms + wm * s, mb + wm * by_blur
        mh, mk, mm = mh + wm * by_u, mk + wm * by_v, mm + wm * miss
    normal[0, 0], normal[1, 0], normal[1, 1] = n1, s1, q1
    normal[2, 0], normal[2, 1], normal[2, 2] = b1, bs, bb
    normal[3, 0], normal[3, 1], normal[3, 2], normal[3, 3] = h1, hs, hb, hh
    normal[4, 0], normal[4, 1], normal[4, 2], normal[4, 3], normal[4, 4] = k1, ks, kb, kh, kk
    right[0], right[1], right[2], right[3], right[4] = m1, ms, mb, mh, mk
    return float(mm)


@inner_loop
def flat_noise(samples: FloatArray, count: int, c: FloatArray, sides: FloatArray) -> None:
    """Sum up the pixels off both edges: sides (2, 3), x y < 0 first.

    How many there are, their model greys, and their squared misses.
    """
    per_blur, shift_u, shift_v = c[16], c[17], c[18]
    sides[:, :] = 0.0
    for i in range(count):
        u, v = samples[0, i], samples[1, i]
        du, dv = u - shift_u, v - shift_v
        x = du * (c[0] + c[2] * du + c[3] * dv) + dv * (c[1] + c[4] * dv)
        y = du * (c[5] + c[7] * du + c[8] * dv) + dv * (c[6] + c[9] * dv)
        if min(abs(x), abs(y)) * per_blur < _FLAT or samples[3, i] == _ZERO:
            continue
        side = 1 if x * y > _ZERO else 0
        light = c[13] + c[14] * u + c[15] * v
        light = light if side == 1 else -light
        grey = c[10] + c[11] * u + c[12] * v + light
        miss = samples[2, i] - grey
        sides[side, 0] += 1.0
        sides[side, 1] += grey
        sides[side, 2] += miss * miss


@inner_loop
def _place(normal: FloatArray, row: int, values: tuple[Any, ...]) -> None:
    for column in range(CORNER_PARAMETERS):
        normal[row, column] = values[column]
