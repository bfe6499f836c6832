"""Corners and discs located by fitting a model of the grey values around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.frames import GreyImage
from core.kernels import CORNER_PARAMETERS, DISC_PARAMETERS, fit_corners, fit_discs
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


def as_float(image: GreyImage) -> FloatArray:
    """Give the grey values as float32, DN."""
    return np.ascontiguousarray(image.pixels, dtype=np.float32)


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
    noise_each = _noise(figures, CORNER_PARAMETERS)
    return CornerFits(
        points_px + state[:, :2],
        _covariances(information, noise_each, ok),
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
    noise = float(np.median(_noise(figures, CORNER_PARAMETERS)[ok]))
    contrast = 2.0 * float(np.median(np.abs(state[ok, 5])))
    return max(noise, _MODEL_SHARE * contrast), float(np.median(state[ok, 8]))


def _noise(figures: FloatArray, parameters: int) -> FloatArray:
    """Root mean square residual per point, DN; rounding to whole values is its floor."""
    freedom = np.maximum(figures[:, 1] - parameters, 1.0)
    return np.sqrt(figures[:, 0] / freedom + 1.0 / 12.0)


def _covariances(information: FloatArray, noise: FloatArray, ok: BoolArray) -> FloatArray:
    covariance = np.full((len(ok), 2, 2), np.nan)
    if ok.any():
        covariance[ok] = np.linalg.inv(information[ok]) * (noise[ok] ** 2)[:, None, None]
    return covariance


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
    noise = _noise(figures, DISC_PARAMETERS)
    ok = figures[:, 4] > 0
    scale = max(float(np.min(noise[ok])) if ok.any() else 1.0, 0.3)
    fit_discs(grey, points, limits, scale, 8, state, information, figures)
    ok = figures[:, 4] > 0
    noise = _noise(figures, DISC_PARAMETERS)
    outline = np.stack([state[:, 2:4], state[:, 3:5]], axis=1)
    return DiscFits(
        points + state[:, :2],
        _covariances(information, noise, ok),
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
