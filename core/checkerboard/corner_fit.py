"""Corners located by fitting a model of the grey values around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.checkerboard.corner_equations import BLUR, CORNER_PARAMETERS, GAIN, SHIFT
from core.checkerboard.corner_kernels import NO_SIDES, fit_corners, fit_even_corners
from core.checkerboard.image_noise import estimate_noise
from core.checkerboard.light_kernels import BOX, box_means
from core.grey_fit import covariances
from core.images import PixelArray

CORNER_REACH_SQUARES = 0.5
"""The model covers the pixels nearer to this corner than to its neighbours."""
_EVEN_BAND_BLURS = 2.1
"""Pixels further than so many blur widths from both edges do not say where they are: half the band
costs 10 % in sigma, twice the band gains nothing (measured)."""
_BAND_PX, _BAND_BLURS = 0.3, 2.2
"""A little wider where the slopes of the light are fitted: px, and blur widths. Insensitive."""
_WIDE_BAND_PX, _WIDE_BAND_BLURS = 2.0, 2.6
"""For squares too small for boxes: wide enough to tell the light's slope from an edge's shift."""
_GAP_PX, _GAP_BLURS = 2.0, 3.0
"""Boxes nearer to an edge, by so many px and blur widths, would see its blur; a wider gap leaves
fewer boxes (sigma grows by 5 % when either is doubled)."""
_BOXES_FROM_PX = 24.0
"""Squares from this side on have room for boxes in each quarter. Without boxes sigma is 8 to 18 %
larger at 40 px a square (measured)."""
_STEPS = 6
"""Gauss-Newton steps at most; three already give the same values (measured)."""
_ODD = 1.3
"""A corner whose misses are so much larger (squared) than most others' has something on it. At
twice that values move by 0.0003 mm at most; below 1 half of all corners would be odd."""
_WINDOW_SPARE, _WINDOW_SPARE_PX = 1.05, 1.0
"""The window about a corner is larger than its squares by this factor and so many px."""


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
    """(n,) rms of the grey values about the model, over white and black."""
    contrast_dn: FloatArray
    """(n,) white minus black."""
    light_dn: FloatArray
    """(n,) mean of white and black."""
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
) -> CornerFits:
    """Locate corners near predicted points.

    pixels (h, w); points_px (n, 2); maps (n, 2, 5): board coordinates about the corner in
    squares as polynomials (u, v, u^2, u v, v^2) of the pixel's offset. A sample of
    corners first gives the noise of white and black, the blur and the shift of the prediction. Then
    most corners take one step; those with something odd about them (a shadow's edge, dust, an
    insect) are fitted with the light's slopes free and less weight for what the model cannot
    explain.
    """
    points_px, maps = np.ascontiguousarray(points_px), np.ascontiguousarray(maps)
    n = len(points_px)
    half_px, square_px = _extent(maps, reach_squares)
    sample = estimate_noise(pixels, points_px, maps, half_px, reach_squares, saturation_dn)
    state, information = np.zeros((n, CORNER_PARAMETERS)), np.zeros((n, 2, 2))
    figures = np.zeros((n, 3))
    blur = float(np.median(sample.blur_and_slopes_px[:, 0])) if n else 1.0
    limits = np.array([reach_squares, _WIDE_BAND_PX + _WIDE_BAND_BLURS * blur, 0.0, saturation_dn])
    boxes, odd = np.zeros((0, 0), np.float32), np.arange(n)
    if square_px > _BOXES_FROM_PX:
        boxes = shrink(pixels)
        limits[1:3] = _EVEN_BAND_BLURS * blur, _GAP_PX + _GAP_BLURS * blur
        fit_even_corners(
            pixels, boxes, sample.predicted_px, maps, half_px, sample.variance_terms, limits,
            sample.blur_and_slopes_px, _STEPS, state, information, figures,
        )  # fmt: skip
        odd = _odd(figures)
        limits[1] = _BAND_PX + _BAND_BLURS * blur
    fit_corners(
        pixels, boxes, sample.predicted_px, maps, half_px, odd, sample.variance_terms, limits,
        sample.blur_and_slopes_px, _STEPS, state, information, figures, NO_SIDES,
    )  # fmt: skip
    ok = figures[:, 2] > 0
    factor = np.sqrt(_residual_ratio(figures))
    return CornerFits(
        sample.predicted_px + state[:, SHIFT:],
        covariances(information, factor, ok),
        ok,
        factor * sample.noise_dn,
        2.0 * np.abs(state[:, GAIN]),
        state[:, 0],
        state[:, BLUR],
    )


def _residual_ratio(figures: FloatArray) -> FloatArray:
    """(n,) mean square of the misses over what the noise explains."""
    # The sum after a step is not evaluated but extrapolated: without noise it may be below 0.
    return np.asarray(np.maximum(figures[:, 0], 0.0) / np.maximum(figures[:, 1], 1.0))


def _odd(figures: FloatArray) -> IntArray:
    """Index of the corners that even light and noise alone do not explain."""
    even, residual_ratio = figures[:, 2] > 0, _residual_ratio(figures)
    if even.any():
        even &= residual_ratio < _ODD * np.median(residual_ratio[even])
    return np.nonzero(~even)[0]


def _extent(maps: FloatArray, reach_squares: float) -> tuple[FloatArray, float]:
    """Half the side of the window about each corner (n,), px, and a typical square's side, px."""
    a, b, c, d = maps[:, 0, 0], maps[:, 0, 1], maps[:, 1, 0], maps[:, 1, 1]
    per_det = 1.0 / np.abs(a * d - b * c)
    wide, tall = np.abs(d) + np.abs(b), np.abs(a) + np.abs(c)
    half = _WINDOW_SPARE * reach_squares * per_det * np.maximum(wide, tall) + _WINDOW_SPARE_PX
    return half, float(np.median(np.sqrt(per_det))) if len(maps) else 0.0
