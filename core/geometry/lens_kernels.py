"""Compiled loops over points: where a lens model images them, with derivatives."""

from __future__ import annotations

import math

import numpy as np

from core.arrays import FloatArray
from core.compiled import compiled, inner_loop

MOST_DISTORTION = 8
"""Coefficients of the longest model (rational); shorter ones are filled up with zeros."""
_ON_AXIS = 1e-7
"""Tangent of the angle from the axis below which theta / r is 1 / z, exact to its square."""


@compiled
def perspective(
    points: FloatArray, p: FloatArray, px: FloatArray, by_point: FloatArray, by_lens: FloatArray
) -> None:
    """Project points (n, 3) by intrinsics p[:5] and k1, k2, p1, p2, k3, k4, k5, k6 = p[5:13].

    px (n, 2), by_point (n, 2, 3) and by_lens (n, 2, m) are filled; m may be any number up to 13.
    Where by_lens has no rows it is left out, and where by_point has none, both.
    """
    m = by_lens.shape[2]
    terms = np.zeros((2, MOST_DISTORTION))
    for n in range(len(points)):
        per_z = 1.0 / points[n, 2]
        x, y = points[n, 0] * per_z, points[n, 1] * per_z
        r2 = x * x + y * y
        above = 1.0 + r2 * (p[5] + r2 * (p[6] + r2 * p[9]))
        below = 1.0 / (1.0 + r2 * (p[10] + r2 * (p[11] + r2 * p[12])))
        radial = above * below
        xd = x * radial + 2.0 * p[7] * x * y + p[8] * (r2 + 2.0 * x * x)
        yd = y * radial + p[7] * (r2 + 2.0 * y * y) + 2.0 * p[8] * x * y
        px[n, 0] = p[0] * xd + p[2] * yd + p[3]
        px[n, 1] = p[1] * yd + p[4]
        if by_point.shape[0] == 0:
            continue
        above_slope = p[5] + r2 * (2.0 * p[6] + 3.0 * r2 * p[9])
        below_slope = p[10] + r2 * (2.0 * p[11] + 3.0 * r2 * p[12])
        slope = 2.0 * below * (above_slope - radial * below_slope)
        xx = radial + x * x * slope + 2.0 * p[7] * y + 6.0 * p[8] * x
        xy = x * y * slope + 2.0 * p[7] * x + 2.0 * p[8] * y
        yy = radial + y * y * slope + 6.0 * p[7] * y + 2.0 * p[8] * x
        by_point[n, 0, 0] = (p[0] * xx + p[2] * xy) * per_z
        by_point[n, 0, 1] = (p[0] * xy + p[2] * yy) * per_z
        by_point[n, 1, 0] = p[1] * xy * per_z
        by_point[n, 1, 1] = p[1] * yy * per_z
        for row in range(2):
            by_point[n, row, 2] = -(x * by_point[n, row, 0] + y * by_point[n, row, 1])
        if by_lens.shape[0] == 0:
            continue
        by_intrinsics(by_lens, n, xd, yd)
        power = r2 * below
        for k, at in enumerate((0, 1, 4)):
            terms[0, at], terms[1, at] = x * power, y * power
            terms[0, 5 + k], terms[1, 5 + k] = -radial * x * power, -radial * y * power
            power *= r2
        terms[0, 2], terms[1, 2] = 2.0 * x * y, r2 + 2.0 * y * y
        terms[0, 3], terms[1, 3] = r2 + 2.0 * x * x, 2.0 * x * y
        for k in range(m - 5):
            by_lens[n, 0, 5 + k] = p[0] * terms[0, k] + p[2] * terms[1, k]
            by_lens[n, 1, 5 + k] = p[1] * terms[1, k]


@inner_loop
def by_intrinsics(by_lens: FloatArray, n: int, xd: float, yd: float) -> None:
    """d(px) by alpha, beta, gamma, mu, nu of point n."""
    for row in range(2):
        for k in range(5):
            by_lens[n, row, k] = 0.0
    by_lens[n, 0, 0], by_lens[n, 1, 1], by_lens[n, 0, 2] = xd, yd, yd
    by_lens[n, 0, 3] = by_lens[n, 1, 4] = 1.0


@compiled
def fisheye(
    points: FloatArray, p: FloatArray, px: FloatArray, by_point: FloatArray, by_lens: FloatArray
) -> None:
    """Project points (n, 3) by intrinsics p[:5] and k1 .. k4 = p[5:9]; otherwise as `perspective`.

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), theta the angle
    from the axis: Kannala and Brandt (2006), as in OpenCV's fisheye module.
    """
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        r = math.sqrt(x * x + y * y)
        theta = math.atan2(r, z)
        t2 = theta * theta
        bent = theta * (1.0 + t2 * (p[5] + t2 * (p[6] + t2 * (p[7] + t2 * p[8]))))
        if r > _ON_AXIS * abs(z):
            per_r = 1.0 / r
            scale = bent * per_r
        else:  # on the axis
            per_r = 0.0
            scale = 1.0 / z
        xd, yd = x * scale, y * scale
        px[n, 0] = p[0] * xd + p[2] * yd + p[3]
        px[n, 1] = p[1] * yd + p[4]
        if by_point.shape[0] == 0:
            continue
        slope = 1.0 + t2 * (3.0 * p[5] + t2 * (5.0 * p[6] + t2 * (7.0 * p[7] + 9.0 * t2 * p[8])))
        per_d2 = 1.0 / (r * r + z * z)
        # d(scale)/dr / r, and d(scale)/dz
        by_r = (slope * z * per_d2 - scale) * per_r * per_r
        by_z = -slope * per_d2
        xx, xy, yy = scale + x * x * by_r, x * y * by_r, scale + y * y * by_r
        xz, yz = x * by_z, y * by_z
        by_point[n, 0, 0], by_point[n, 0, 1] = p[0] * xx + p[2] * xy, p[0] * xy + p[2] * yy
        by_point[n, 0, 2] = p[0] * xz + p[2] * yz
        by_point[n, 1, 0], by_point[n, 1, 1], by_point[n, 1, 2] = p[1] * xy, p[1] * yy, p[1] * yz
        if by_lens.shape[0] == 0:
            continue
        by_intrinsics(by_lens, n, xd, yd)
        power = theta * per_r
        for k in range(4):
            power *= t2
            by_lens[n, 0, 5 + k] = (p[0] * x + p[2] * y) * power
            by_lens[n, 1, 5 + k] = p[1] * y * power
