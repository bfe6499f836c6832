"""Corners located by fitting a model of the grey values around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.corner_kernels import (
    BLUR,
    BOX,
    CORNER_PARAMETERS,
    GAIN,
    SHIFT,
    box_means,
    fit_corners,
)
from core.frames import PixelArray
from core.pixel_fit import covariances, residual_noise
from core.site import BoolArray, FloatArray

CORNER_REACH_SQUARES = 0.49
"""The model covers the pixels nearer to this corner than to its neighbours."""
_SAMPLE_BAND_PX, _SAMPLE = 6.0, 30
_BAND_PX, _BAND_BLURS = 0.3, 2.2
"""Pixels further than this (plus so many blur widths) from both edges say where no edge is."""
_WIDE_BAND_PX, _WIDE_BAND_BLURS = 2.0, 2.6
"""For squares too small for boxes: wide enough to tell the light's slope from an edge's shift."""
_GAP_PX, _GAP_BLURS = 2.0, 3.0
"""Boxes nearer to an edge would see its blur."""
_BOXES_FROM_PX = 24.0
_MODEL_SHARE = 0.007
_STEPS, _SAMPLE_STEPS = 6, 3


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


def shrink(pixels: PixelArray) -> FloatArray:
    """Shrink an image to the means of its boxes of BOX x BOX px, float32; a rest is cut off."""
    small = np.empty((pixels.shape[0] // BOX, pixels.shape[1] // BOX), np.float32)
    box_means(pixels, small)
    return small


def locate_corners(
    pixels: PixelArray,
    saturation_dn: float,
    points_px: FloatArray,
    maps: FloatArray,
    reach_squares: float = CORNER_REACH_SQUARES,
    small: FloatArray | None = None,
) -> CornerFits:
    """Locate corners near predicted points.

    pixels (h, w); points_px (n, 2); maps (n, 2, 5): board coordinates about the corner in
    squares as polynomials (u, v, u^2, u v, v^2) of the pixel's offset; small: the image as
    `shrink` makes it. A few corners tell the noise first, so that the fit can fade out the
    pixels that the model cannot explain.
    """
    points_px, maps = np.ascontiguousarray(points_px), np.ascontiguousarray(maps)
    half, square_px = _extent(maps, reach_squares)
    none = np.zeros((0, 0), np.float32)
    limits = np.array([reach_squares, _SAMPLE_BAND_PX, 0.0, saturation_dn])
    some = slice(None, None, max(1, len(points_px) // _SAMPLE))
    sample = (pixels, none, points_px[some], maps[some], half[some])
    state, _, figures = _fit(*sample, 0.0, limits, 1.0, _SAMPLE_STEPS)
    scale_dn, blur = _typical(state, figures)
    boxes = none
    limits[1] = _WIDE_BAND_PX + _WIDE_BAND_BLURS * blur
    if square_px > _BOXES_FROM_PX:
        boxes = shrink(pixels) if small is None else small
        limits[1] = _BAND_PX + _BAND_BLURS * blur
        limits[2] = _GAP_PX + _GAP_BLURS * blur
    state, information, figures = _fit(
        pixels, boxes, points_px, maps, half, scale_dn, limits, blur, _STEPS
    )
    ok = figures[:, 2] > 0
    noise = residual_noise(figures, CORNER_PARAMETERS)
    return CornerFits(
        points_px + state[:, SHIFT:],
        covariances(information, noise, ok),
        ok,
        noise,
        2.0 * np.abs(state[:, GAIN]),
        state[:, BLUR],
    )


def _extent(maps: FloatArray, reach_squares: float) -> tuple[FloatArray, float]:
    """Half the side of the window about each corner (n,), px, and a typical square's side, px."""
    to_px = np.linalg.inv(maps[:, :, :2])
    half = 1.05 * reach_squares * np.abs(to_px).sum(axis=2).max(axis=1) + 1.0
    sides = np.sqrt((to_px * to_px).sum(axis=1))
    return half, float(np.median(sides)) if len(sides) else 0.0


def _fit(
    pixels: PixelArray,
    boxes: FloatArray,
    points: FloatArray,
    maps: FloatArray,
    half: FloatArray,
    scale_dn: float,
    limits: FloatArray,
    blur: float,
    steps: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Run the compiled fit: state, information, figures."""
    n = len(points)
    state, information = np.zeros((n, CORNER_PARAMETERS)), np.zeros((n, 2, 2))
    figures = np.zeros((n, 3))
    points, maps, half = (np.ascontiguousarray(a) for a in (points, maps, half))
    fit_corners(
        pixels, boxes, points, maps, half, scale_dn, limits, blur, steps,
        state, information, figures,
    )  # fmt: skip
    return state, information, figures


def _typical(state: FloatArray, figures: FloatArray) -> tuple[float, float]:
    """Scale of the residuals, DN, and blur, px, by the median of a sample of corners.

    The scale is their rms, or what of the contrast a blur that changes over a corner's pixels
    may leave unexplained, whichever is larger.
    """
    ok = figures[:, 2] > 0
    if not ok.any():
        return 1.0, 1.0
    noise = float(np.median(residual_noise(figures, CORNER_PARAMETERS)[ok]))
    contrast = 2.0 * float(np.median(np.abs(state[ok, GAIN])))
    return max(noise, _MODEL_SHARE * contrast), float(np.median(state[ok, BLUR]))
