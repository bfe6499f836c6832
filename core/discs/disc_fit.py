"""Discs located by fitting a model of the grey values around their outlines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.discs.disc_kernels import DISC_PARAMETERS, Pixels, fit_discs
from core.grey_fit import SETTLED_PX, covariances, residual_noise

_NARROW_PX, _NARROW_BLURS = 2.0, 3.0
"""Beyond this, plus so many blur widths, a pixel tells no more than the grey on either side."""
_COARSE_SHARE, _COARSE_PX = 0.35, (3.0, 8.0)
_LARGE_SHARE = 0.2
"""A large disc was found in an image of a fraction of the size, its outline as roughly."""
_COARSE_PIXELS = 600
_NEARLY_PX = 0.05
_TURNS = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)


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
    explained_fraction: FloatArray
    """(n,) share of the outline's pixels that the model explains."""


def locate_discs(
    pixels: Pixels, saturation_dn: float, points_px: FloatArray, outline_px: FloatArray
) -> DiscFits:
    """Locate bright discs near points (n, 2) with outlines (n, 2, 2) known to some 15 %.

    First roughly, with some of the pixels of a wide ring about each outline; then with all
    pixels of a ring that the blur makes as narrow as it may be, and less weight for those that
    the model does not explain.
    """
    pixels = np.ascontiguousarray(pixels)
    points = np.ascontiguousarray(points_px, dtype=float)
    n = len(points)
    state = _start(pixels, points, outline_px)
    information, figures = np.zeros((n, 2, 2)), np.zeros((n, 5))
    radius = np.trace(outline_px, axis1=1, axis2=2) / 2.0
    wide = np.maximum(np.clip(_COARSE_SHARE * radius, *_COARSE_PX), _LARGE_SHARE * radius)
    every = np.maximum(1, 12.6 * radius * wide / _COARSE_PIXELS)
    every = every.astype(np.int64)
    limits = np.array([saturation_dn, 0.0, _NEARLY_PX])
    fit_discs(pixels, points, wide, every, limits, 10, state, information, figures)
    noise = residual_noise(figures, DISC_PARAMETERS)
    ok = figures[:, 4] > 0
    limits[1:] = max(float(np.min(noise[ok])) if ok.any() else 1.0, 0.3), SETTLED_PX
    narrow = np.where(ok, np.minimum(wide, _NARROW_PX + _NARROW_BLURS * state[:, 11]), 0.0)
    state[~ok, 2:5] = 0.0
    all_pixels = np.ones(n, dtype=np.int64)
    fit_discs(pixels, points, narrow, all_pixels, limits, 8, state, information, figures)
    ok = ok & (figures[:, 4] > 0)
    noise = residual_noise(figures, DISC_PARAMETERS)
    return DiscFits(
        points + state[:, :2],
        covariances(information, noise, ok),
        ok,
        np.stack([state[:, 2:4], state[:, 3:5]], axis=1),
        noise,
        np.abs(state[:, 8]),
        state[:, 11],
        figures[:, 3] / np.maximum(figures[:, 2], 1.0),
    )


def _start(pixels: Pixels, points: FloatArray, outline: FloatArray) -> FloatArray:
    """Start values (n, 12): the levels from pixels well inside and outside the outline."""
    ring = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1) @ outline
    levels = []
    for factor in (0.65, 1.35):
        at = np.rint(points[:, None] + factor * ring).astype(int)
        u = np.clip(at[..., 0], 0, pixels.shape[1] - 1)
        v = np.clip(at[..., 1], 0, pixels.shape[0] - 1)
        levels.append(np.median(pixels[v, u], axis=1))
    high, low = levels
    state = np.zeros((len(points), DISC_PARAMETERS))
    state[:, 2], state[:, 3], state[:, 4] = outline[:, 0, 0], outline[:, 0, 1], outline[:, 1, 1]
    state[:, 5], state[:, 8], state[:, 11] = low, high - low, 1.0
    return state
