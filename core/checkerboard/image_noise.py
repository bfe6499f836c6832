"""The noise, the blur and the shift of an image, from a few corners before all are fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.checkerboard.corner_equations import BLUR, CORNER_PARAMETERS, GAIN
from core.checkerboard.corner_kernels import fit_corners
from core.images import PixelArray

_SAMPLE = 30
"""Corners of the sample. Chosen: twice as many change a value by 0.0006 mm at most; half as many
are too few for the field (measured: 0.02 mm)."""
_STEPS = 3
"""Gauss-Newton steps for each of them; more change nothing."""
_BAND_PX = 6.0
"""Pixels nearer than this to an edge are fitted: wide, for a prediction that is off by a pixel or
so. Halved or doubled, values move by 0.0012 mm at most."""
_GOLDEN = 0.618
"""Of all corners: stepping on by this share and around visits all parts of the board."""
_FEWEST_FLAT, _FEWEST_CORNERS = 8.0, 3
"""Pixels a side, off the edges, of a corner that tells the noise; and such corners. Insensitive."""
_FEWEST_FOR_FIELD = 18
"""Corners for the six terms of the shift and of the blur over the image: three each."""
_OUTLIER_FACTOR, _LIKE_OTHERS_PX = 4.0, 0.05
"""A corner is left out beyond this multiple of the median miss of the field, and this more. Chosen;
insensitive."""
_ROUNDING_DN2 = 1.0 / 12.0
"""Variance of a grey value that was rounded to a whole number."""
_MOST_RATIO = 25.0
"""Of the variances: black that is cut off at 0 has none, and would count for everything."""
_BEYOND = 2.0
"""The light is uneven: somewhere the variance is larger or smaller than at the median corner."""
_MODEL_SHARE, _UNEVEN_SHARE = 0.007, 0.003
"""Of the contrast, rms: what a blur that changes over a corner's pixels may leave unexplained, and
by how much light that counts as linear may be off. Insensitive."""


@dataclass(frozen=True, slots=True)
class GreyNoise:
    """Variance of grey values, linear in the grey value as shot and read noise make it.

    Measured in the image itself, so that neither gain nor bits need to be known.
    """

    at_zero_dn2: float
    by_grey_dn: float
    least_dn2: float
    most_dn2: float

    @classmethod
    def constant(cls, variance_dn2: float) -> GreyNoise:
        """Noise that is the same in white and in black."""
        return cls(variance_dn2, 0.0, variance_dn2, variance_dn2)

    @classmethod
    def through(cls, greys_dn: FloatArray, variances_dn2: FloatArray) -> GreyNoise:
        """Through the variances (2,) at two grey values (2,)."""
        most = max(float(variances_dn2.max()), _ROUNDING_DN2)
        dark, bright = np.maximum(variances_dn2, max(most / _MOST_RATIO, _ROUNDING_DN2))
        by_grey = float(bright - dark) / float(greys_dn[1] - greys_dn[0])
        least = max(min(dark, bright) / _BEYOND, _ROUNDING_DN2)
        return cls(float(dark - by_grey * greys_dn[0]), by_grey, float(least), most * _BEYOND)

    def variance_terms(self, contrast_dn: float) -> FloatArray:
        """(6,) the terms of a pixel's variance as `corner_kernels.fit_corners` takes them, DN^2."""
        allowed = [(share * contrast_dn) ** 2 for share in (_MODEL_SHARE, _UNEVEN_SHARE)]
        variance = [self.at_zero_dn2, self.by_grey_dn, self.least_dn2, self.most_dn2]
        return np.array([*variance, *allowed])


_UNWEIGHTED = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 0.0])
"""Variance terms under which every pixel counts alike."""


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """Noise, blur and shift of an image by a sample of its corners."""

    predicted_px: FloatArray
    """(n, 2) where all corners are expected, with the shift of the sample."""
    blur_and_slopes_px: FloatArray
    """(n, 3) 1-sigma blur at each corner, and its slopes by u and v."""
    noise: GreyNoise
    noise_dn: float
    """rms over white and black."""
    variance_terms: FloatArray
    """(6,) see GreyNoise.variance_terms."""


def estimate_noise(
    pixels: PixelArray,
    points_px: FloatArray,
    maps: FloatArray,
    half_px: FloatArray,
    reach_squares: float,
    saturation_dn: float,
) -> NoiseEstimate:
    """Fit some corners, every pixel alike, from predictions that may be off by a pixel or so."""
    n = len(points_px)
    some = _sample_indices(n)
    state, information = np.zeros((n, CORNER_PARAMETERS)), np.zeros((n, 2, 2))
    figures, sides = np.zeros((n, 3)), np.zeros((n, 2, 3))
    limits = np.array([reach_squares, _BAND_PX, 0.0, saturation_dn])
    fit_corners(
        pixels, np.zeros((0, 0), np.float32), points_px, maps, half_px, some, _UNWEIGHTED, limits,
        _no_slopes(n, 1.0), _STEPS, state, information, figures, sides,
    )  # fmt: skip
    some = some[figures[some, 2] > 0]
    if len(some) == 0:
        noise = GreyNoise.constant(1.0)
        return NoiseEstimate(points_px, _no_slopes(n, 1.0), noise, 1.0, noise.variance_terms(0.0))
    noise, noise_dn = _noise_of_sample(state[some], sides[some], figures[some])
    shift_px, blur_px = _fields(points_px, some, state[some, BLUR:])
    contrast_dn = 2.0 * float(np.median(np.abs(state[some, GAIN])))
    return NoiseEstimate(
        points_px + shift_px, blur_px, noise, noise_dn, noise.variance_terms(contrast_dn)
    )


def _noise_of_sample(
    state: FloatArray, sides: FloatArray, figures: FloatArray
) -> tuple[GreyNoise, float]:
    """Median of what the corners' dark and bright pixels off the edges say, and the rms of both."""
    sides = np.where((state[:, GAIN] > 0.0)[:, None, None], sides, sides[:, ::-1])
    enough = (sides[:, :, 0] >= _FEWEST_FLAT).all(axis=1)
    if enough.sum() < _FEWEST_CORNERS:
        variance = max(float(np.median(figures[:, 0] / figures[:, 1])), _ROUNDING_DN2)
        return GreyNoise.constant(variance), float(np.sqrt(variance))
    means = sides[enough, :, 1:] / sides[enough, :, :1]
    greys, variances = np.median(means[:, :, 0], axis=0), np.median(means[:, :, 1], axis=0)
    rms_dn = float(np.sqrt(max(variances.mean(), _ROUNDING_DN2)))
    if not greys[1] > greys[0]:
        return GreyNoise.constant(rms_dn**2), rms_dn
    return GreyNoise.through(greys, variances), rms_dn


def _fields(
    points_px: FloatArray, some: IntArray, found: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Shift (n, 2) and blur (n, 3) of all corners from those of some, as they vary over the image.

    Quadratic in the place, which is as much as a small step of the pose or a lens makes of it;
    corners that do not fit in (under an insect) are left out. found (k, 3): blur and shift.
    """
    n = len(points_px)
    if len(some) < _FEWEST_FOR_FIELD:
        return np.zeros((n, 2)), _no_slopes(n, float(np.median(found[:, 0])))
    middle = points_px.mean(axis=0)
    size_px = max(float(np.abs(points_px - middle).max()), 1.0)
    u, v = (points_px - middle).T / size_px
    basis = np.stack([np.ones(n), u, v, u * u, u * v, v * v], axis=1)
    keep: BoolArray = np.ones(len(some), dtype=bool)
    for _ in range(2):
        field = np.linalg.lstsq(basis[some[keep]], found[keep], rcond=None)[0]
        off = np.abs(found - basis[some] @ field)
        fits = (off <= _OUTLIER_FACTOR * np.median(off, axis=0) + _LIKE_OTHERS_PX).all(axis=1)
        if (fits >= keep).all():
            break
        keep = fits
        if keep.sum() < _FEWEST_FOR_FIELD:
            return np.zeros((n, 2)), _no_slopes(n, float(np.median(found[:, 0])))
    everywhere = (basis @ field).clip(found[keep].min(axis=0), found[keep].max(axis=0))
    _, by_u, by_v, by_uu, by_uv, by_vv = field[:, 0] / size_px
    slopes = [by_u + 2.0 * by_uu * u + by_uv * v, by_v + by_uv * u + 2.0 * by_vv * v]
    return everywhere[:, 1:], np.stack([everywhere[:, 0], *slopes], axis=1)


def _no_slopes(n: int, blur_px: float) -> FloatArray:
    return np.tile([blur_px, 0.0, 0.0], (n, 1))


def _sample_indices(n: int) -> IntArray:
    """Indices of some of n corners, evenly spread and not along lines of the board."""
    step = max(round(_GOLDEN * n), 1)
    while math.gcd(step, n) > 1:
        step += 1
    return np.sort(np.arange(min(n, _SAMPLE)) * step % max(n, 1))
