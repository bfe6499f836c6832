"""Discs located by fitting a model of the grey values around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.disc_kernels import DISC_PARAMETERS, fit_discs
from core.pixel_fit import covariances, residual_noise
from core.site import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class DiscFits:
    """Discs located by their grey values."""

    points_px: FloatArray
    """(n, 2) centres of the outlines."""
    covariance_px2: FloatArray
    """(n, 2, 2)."""
    usable: BoolArray
    """(n,)."""
    outline_px: FloatArray
    """(n, 2, 2) symmetric matrix taking the unit circle to the outline."""
    noise_dn: FloatArray
    contrast_dn: FloatArray
    blur_px: FloatArray
    clean: FloatArray
    """(n,) share of the outline's pixels that the model explains."""


def locate_discs(
    grey: FloatArray, saturation_dn: float, points_px: FloatArray, outline_px: FloatArray
) -> DiscFits:
    """Locate bright discs near points (n, 2) with outlines (n, 2, 2) known to some 15 %."""
    n = len(points_px)
    state = np.zeros((n, DISC_PARAMETERS))
    information, figures = np.zeros((n, 2, 2)), np.zeros((n, 5))
    for k in range(n):
        state[k] = _start_disc(grey, points_px[k], outline_px[k])
    radius = float(np.median(np.trace(outline_px, axis1=1, axis2=2) / 2.0))
    limits = np.array([float(np.clip(0.35 * radius, 3.0, 8.0)), saturation_dn])
    points = np.ascontiguousarray(points_px, dtype=float)
    fit_discs(grey, points, limits, 0.0, 8, state, information, figures)
    noise = residual_noise(figures, DISC_PARAMETERS)
    ok = figures[:, 4] > 0
    scale = max(float(np.min(noise[ok])) if ok.any() else 1.0, 0.3)
    fit_discs(grey, points, limits, scale, 8, state, information, figures)
    ok = figures[:, 4] > 0
    noise = residual_noise(figures, DISC_PARAMETERS)
    outline = np.stack([state[:, 2:4], state[:, 3:5]], axis=1)
    return DiscFits(
        points + state[:, :2],
        covariances(information, noise, ok),
        ok,
        outline,
        noise,
        np.abs(state[:, 8]),
        state[:, 11],
        figures[:, 3] / np.maximum(figures[:, 2], 1.0),
    )


def _start_disc(grey: FloatArray, point: FloatArray, outline: FloatArray) -> FloatArray:
    """Start values: the levels from pixels inside and outside the outline."""
    reach = int(np.ceil(outline[0, 0] + outline[1, 1]))
    u0, v0 = round(float(point[0])), round(float(point[1]))
    v, u = np.mgrid[max(0, v0 - reach) : v0 + reach + 1, max(0, u0 - reach) : u0 + reach + 1]
    inside_image = (v < grey.shape[0]) & (u < grey.shape[1])
    u, v = u[inside_image], v[inside_image]
    offset = np.stack([u - point[0], v - point[1]], axis=1) @ np.linalg.inv(outline).T
    rho = np.hypot(offset[:, 0], offset[:, 1])
    values = grey[v, u]
    white, black = values[rho < 0.8], values[(rho > 1.2) & (rho < 1.5)]
    low = float(np.median(black)) if len(black) else 0.0
    high = float(np.median(white)) if len(white) else low + 1.0
    start = np.zeros(DISC_PARAMETERS)
    start[2:5] = outline[0, 0], outline[0, 1], outline[1, 1]
    start[5], start[8], start[11] = low, high - low, 1.0
    return start
