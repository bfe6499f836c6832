"""What a pixel of a blurred image responds to: its own square, spread by the lens.

Both are separable: along either axis of the image the same density b weighs the light, and the
share that a region has in a pixel is the integral of b(u) b(v) over it. `kernels.py` gives such
integrals for straight edges at any angle and distance; nothing is sampled in the image, so there
is no raster that an edge could be parallel to. The tables are sums over densities. No error
function anywhere: the estimators use one, and the simulation must not share their model.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from core.arrays import FloatArray
from drivers.sim.kernels import PER_PX, SLOPES, Response

_SIGMAS = 4.0
"""Where the Gaussian ends."""


@lru_cache(maxsize=8)
def pixel_response(blur_px: float) -> Response:
    """Tabulate a square pixel, blurred by a Gaussian with this sigma."""
    quarter = PER_PX // 4
    half = math.ceil(4.0 * (_SIGMAS * blur_px + 0.5)) * quarter
    axis = np.arange(-half, half + 1) / PER_PX
    gaussian = _summed(np.exp(-0.5 * (axis / blur_px) ** 2))
    density = np.interp(axis + 0.5, axis, gaussian) - np.interp(axis - 0.5, axis, gaussian)
    across, weight = axis[::quarter], density[::quarter]  # ample: it converges exponentially
    weight = weight / weight.sum()
    distance = np.arange(-3 * half // 2, 3 * half // 2 + 1) / PER_PX
    edges = [
        weight @ np.interp(distance + slope * across[:, None], axis, _summed(density))
        for slope in np.linspace(0.0, 1.0, SLOPES + 1)
    ]
    return Response(half / PER_PX, float(weight @ across**2), density, np.array(edges))


def _summed(density: FloatArray) -> FloatArray:
    """Integral from the left by trapezes, scaled to end at 1."""
    total = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    return np.asarray(total / total[-1])
