"""Corners located by fitting a model of the grey values around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.corner_kernels import CORNER_PARAMETERS, fit_corners
from core.pixel_fit import covariances, residual_noise
from core.site import BoolArray, FloatArray

CORNER_REACH_SQUARES = 0.46
"""The model covers the pixels nearer to this corner than to its neighbours."""
_SAMPLE_BAND_PX, _BAND_PX, _BAND_BLURS = 8.0, 2.0, 2.6
"""Pixels further than this (plus so many blur widths) from both edges are flat and add nothing."""
_MODEL_SHARE = 0.007


@dataclass(frozen=True, slots=True)
class CornerFits:
    """Corners located by their grey values."""

    points_px: FloatArray
    """(n, 2)."""
    covariance_px2: FloatArray
    """(n, 2, 2) from the noise measured about each corner."""
    usable: BoolArray
    """(n,)."""
    noise_dn: FloatArray
    """(n,) rms of the grey values about the model."""
    contrast_dn: FloatArray
    """(n,) white minus black."""
    blur_px: FloatArray
    """(n,) 1-sigma width of the edges."""


def locate_corners(
    grey: FloatArray,
    saturation_dn: float,
    points_px: FloatArray,
    maps: FloatArray,
    reach_squares: float = CORNER_REACH_SQUARES,
) -> CornerFits:
    """Locate corners near predicted points.

    grey (h, w) float32; points_px (n, 2); maps (n, 2, 5): board coordinates about the corner in
    squares as polynomials (u, v, u^2, u v, v^2) of the pixel's offset. A few corners tell the
    noise first, so that the fit can fade out the pixels that the model cannot explain.
    """
    points_px, maps = np.ascontiguousarray(points_px), np.ascontiguousarray(maps)
    to_px = np.linalg.inv(maps[:, :, :2])
    half = 1.05 * reach_squares * np.abs(to_px).sum(axis=2).max(axis=1) + 1.0
    limits = np.array([reach_squares, _SAMPLE_BAND_PX, saturation_dn])
    scale_dn, blur = _typical(grey, points_px, maps, half, limits)
    limits[1] = _BAND_PX + _BAND_BLURS * blur
    n = len(points_px)
    state = np.zeros((n, CORNER_PARAMETERS))
    state[:, 8] = blur
    information, figures = np.zeros((n, 2, 2)), np.zeros((n, 4))
    scale = np.full(n, scale_dn)
    fit_corners(grey, points_px, maps, half, scale, limits, 6, state, information, figures)
    ok = figures[:, 3] > 0
    noise_each = residual_noise(figures, CORNER_PARAMETERS)
    return CornerFits(
        points_px + state[:, :2],
        covariances(information, noise_each, ok),
        ok,
        noise_each,
        2.0 * np.abs(state[:, 5]),
        state[:, 8],
    )


def _typical(
    grey: FloatArray, points: FloatArray, maps: FloatArray, half: FloatArray, limits: FloatArray
) -> tuple[float, float]:
    """Scale of the residuals, DN, and blur, px, by the median of a sample of corners.

    The scale is their rms, or what of the contrast a blur that changes over a corner's pixels
    may leave unexplained, whichever is larger.
    """
    some = slice(None, None, max(1, len(points) // 60))
    at, around, reach = (np.ascontiguousarray(array[some]) for array in (points, maps, half))
    n = len(at)
    state, figures = np.zeros((n, CORNER_PARAMETERS)), np.zeros((n, 4))
    state[:, 8] = 1.0
    information = np.zeros((n, 2, 2))
    fit_corners(grey, at, around, reach, np.zeros(n), limits, 4, state, information, figures)
    ok = figures[:, 3] > 0
    if not ok.any():
        return 1.0, 1.0
    noise = float(np.median(residual_noise(figures, CORNER_PARAMETERS)[ok]))
    contrast = 2.0 * float(np.median(np.abs(state[ok, 5])))
    return max(noise, _MODEL_SHARE * contrast), float(np.median(state[ok, 8]))
