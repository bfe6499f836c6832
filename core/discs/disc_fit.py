"""Discs located by fitting a model of the grey values around their outlines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.discs.disc_kernels import DISC_PARAMETERS, Pixels, fit_discs
from core.grey_fit import MIN_PIXELS, covariances, residual_noise

_NARROW_PX, _NARROW_BLURS = 2.0, 3.0
"""Half the width of the last ring, px. Beyond 2 px plus 3 blur widths erf is flat: a pixel there
shows only the grey value of its side."""
_COARSE_SHARE, _COARSE_PX = 0.35, (3.0, 8.0)
"""Half the width of the first ring, as a share of the radius and within these bounds: chosen by
hand, so that an outline known to 15 % lies in it."""
_LARGE_SHARE = 0.2
"""The same as a share of the radius from 40 px on, without a bound. Chosen: a large disc was found
in an image of a fraction of the size, its outline as roughly; 15 % still lies in it."""
_COARSE_PIXELS = 600
"""Pixels that the first fit takes of each ring, for speed: chosen by hand, 50 to a parameter."""
_START_BLUR_PX, _START_BLUR_SHARE = 1.0, 0.3
"""Blur to start from, as a share of the first ring. From 1.5 px and 10 % of the radius off, 5
rendered plates started 40 times failed at no share from 0.15 to 0.5; at 0.7, two discs did."""
_COARSE_STEPS, _STEPS = 20, 20
"""Bounds on the work, chosen by hand; a fit ends earlier once a step is small."""
_ROUNDS, _SAME_NOISE = 6, 0.002
"""Ring and noise are taken from the fit before, until the noise changes by less than this share."""
_NEARLY_PX, _SETTLED_PX = 0.05, 0.0005
"""A last step of so much: for the first ring, and where the result must not depend on the start.

Chosen to be half the 0.001 px to which starts shall agree.
"""
_MODEL_SHARE = 5e-4
"""Of the contrast: what the model of a sharp disc leaves of a drawn one without noise is half of it
(2.5e-4, 16 bits). Real noise, also of a mean of eight images, is several times as much."""
_LEAST_NOISE_DN = 0.3
"""Rounding to whole values alone: sqrt(1 / 12)."""
_SAMPLING_PX, _SAMPLING_DECAY = 0.0183, 10.7
"""Error of a place, px, that pixels too wide for a sharp lens make: 0.0183 exp(-10.7 blur^2) /
sqrt(radius). Measured on drawn discs without noise, radii of 8 to 40 px, blurs (the pixel's own
width in them) of 0.36 to 0.67 px: right to a third. It falls as a Gaussian's image of the
sampling frequency does."""
_BLUR = 11
"""Index of the blur among the parameters."""
_NOISE = [1, 3]
"""Of the limits of `fit_discs`: in black and in white."""
_GEOMETRY = np.array([0, 1, 2, 3, 4, _BLUR])
"""The parameters in px: place, outline, blur."""
_TURNS = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
"""Directions, rad, in which the first grey levels are read. Chosen: enough for a median."""


@dataclass(frozen=True, slots=True)
class DiscFits:
    """Discs located by their grey values."""

    points_px: FloatArray
    """(n, 2) centres of the outlines."""
    covariance_px2: FloatArray
    """(n, 2, 2) from the noise of the grey values, and from their sampling."""
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
    the model does not explain. Ring and noise of the last fit come from the fit before it, so that
    neither the result nor its weights depend on the points and outlines given.

    >>> v, u = np.mgrid[:60, :80]
    >>> grey = 30.0 + 180.0 * np.clip(16.5 - np.hypot(u - 40.3, v - 28.7), 0.0, 1.0)
    >>> start = np.array([[39.5, 29.5]]), 15.0 * np.eye(2)[None]
    >>> fits = locate_discs(grey.round().astype(np.uint8), 255.0, *start)
    >>> fits.points_px.round(1).tolist(), fits.contrast_dn.round(-1).tolist()
    ([[40.3, 28.7]], [180.0])
    """
    pixels = np.ascontiguousarray(pixels)
    points = np.ascontiguousarray(points_px, dtype=float)
    n = len(points)
    state = _start(pixels, points, outline_px)
    information, figures = np.zeros((n, 2, 2)), np.zeros((n, 9))
    wide = _wide_px(state)
    every = np.maximum(1, 2.0 * np.pi * (state[:, 2] + state[:, 4]) * wide / _COARSE_PIXELS)
    every = every.astype(np.int64)
    limits = np.array([saturation_dn, 0.0, _NEARLY_PX, 0.0])
    fit_discs(pixels, points, wide, every, limits, _COARSE_STEPS, state, information, figures)
    every[:], limits[2] = 1, _SETTLED_PX
    ok = figures[:, 4] > 0
    noise_dn2 = _least_noise_dn2(state, figures, ok)
    for _ in range(_ROUNDS):
        before, limits[_NOISE] = state.copy(), noise_dn2
        reach = np.minimum(_wide_px(state), _NARROW_PX + _NARROW_BLURS * state[:, _BLUR])
        state[~ok, 2:5] = 0.0
        fit_discs(
            pixels, points, np.where(ok, reach, 0.0), every, limits, _STEPS, state, information,
            figures,
        )  # fmt: skip
        ok = ok & (figures[:, 4] > 0)
        moved = np.abs(state - before)[ok][:, _GEOMETRY]
        noise_dn2 = _least_noise_dn2(state, figures, ok)
        change = np.abs(noise_dn2 - limits[_NOISE])
        same_noise = (change < 2.0 * _SAME_NOISE * limits[_NOISE]).all()
        if same_noise and (moved < _SETTLED_PX).all():
            break
    # A place is read half-way between black and white; of the ring less than half is white.
    noise = np.sqrt(_noise_dn2(figures).mean(axis=1))
    return DiscFits(
        points + state[:, :2],
        covariances(information, noise, ok) + _sampling_px2(state)[:, None, None] * np.eye(2),
        ok,
        np.stack([state[:, 2:4], state[:, 3:5]], axis=1),
        noise,
        np.abs(state[:, 8]),
        state[:, _BLUR],
        figures[:, 3] / np.maximum(figures[:, 2], 1.0),
    )


def _noise_dn2(figures: FloatArray) -> FloatArray:
    """Noise (n, 2) in black and in white, DN^2: as the residuals off the edge share it.

    Its level is that of all residuals: where the model fits an edge badly that counts as noise.
    """
    whole = residual_noise(figures, DISC_PARAMETERS)[:, None] ** 2
    squares, weights = figures[:, 5::2], figures[:, 6::2]
    sides = np.maximum(squares / np.maximum(weights, 1.0), _LEAST_NOISE_DN**2)
    over_ring = (weights * sides).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)
    share = sides / np.maximum(over_ring, _LEAST_NOISE_DN**2)[:, None]
    enough = weights.min(axis=1, keepdims=True) >= MIN_PIXELS
    return np.asarray(np.where(enough, share, 1.0) * whole)


def _least_noise_dn2(state: FloatArray, figures: FloatArray, ok: BoolArray) -> FloatArray:
    """Noise (2,) of the quietest disc in black and in white, DN^2.

    What something lies on must not call itself noisy.
    """
    if not ok.any():
        return np.ones(2)
    model_dn = _MODEL_SHARE * float(np.median(np.abs(state[ok, 8])))
    least_dn2 = max(model_dn, _LEAST_NOISE_DN) ** 2
    return np.asarray(np.maximum(_noise_dn2(figures)[ok].min(axis=0), least_dn2))


def _sampling_px2(state: FloatArray) -> FloatArray:
    """Variance (n,) of each coordinate of a place, px^2, by where the pixels lie on the outline."""
    radius = np.maximum(0.5 * (state[:, 2] + state[:, 4]), 1.0)
    sigma = _SAMPLING_PX * np.exp(-_SAMPLING_DECAY * state[:, _BLUR] ** 2)
    return np.asarray(sigma**2 / radius)


def _wide_px(state: FloatArray) -> FloatArray:
    """Half the width of a ring (n,) about outlines that may be off by a share of their size."""
    radius = 0.5 * (state[:, 2] + state[:, 4])
    return np.maximum(np.clip(_COARSE_SHARE * radius, *_COARSE_PX), _LARGE_SHARE * radius)


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
    state[:, 5], state[:, 8] = low, high - low
    state[:, _BLUR] = np.maximum(_START_BLUR_PX, _START_BLUR_SHARE * _wide_px(state))
    return state
