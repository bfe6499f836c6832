"""Candidates for checkerboard corners: saddle points of the grey values, checked on a ring."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from core.arrays import BoolArray, FloatArray, IntArray

RING_SAMPLES = 48
"""Grey values on the ring about a candidate. Chosen; insensitive."""
_SMOOTHING_PX = 1.5
"""1 sigma of the blur before derivatives are taken: against noise, and narrow beside squares of
9 px. Halved or doubled, values move by 0.0012 mm at most."""
_PEAK_PX = 7
"""A candidate is the strongest within this square; corners lie further apart."""
_LOCAL_SHRINK, _LOCAL_CELLS = 0.125, 25
"""The strength of the neighbourhood: the largest mean of 8 x 8 px within 25 x 25 of those."""
_LEAST_LOCAL_SHARE, _LEAST_STRENGTH = 0.15, 0.05
"""A candidate's strength over its neighbourhood's, and in DN^2/px^4. Chosen low: the ring
decides."""
_FEWEST_CANDIDATES, _PIXELS_A_CANDIDATE, _MOST_CANDIDATES = 5000, 300, 20_000
"""The strongest candidates are looked at: one for so many pixels, within these bounds. A board has
some thousand corners, and noise must not cost more than ten times its decoding."""
_LEAST_SYMMETRY = 0.7
"""Correlation of the ring with itself turned by half: 1 for a corner, 0 for noise."""
_LEAST_POWER_DN2 = 4.0
"""Mean square of the ring's grey values about their mean: a contrast of about 4 DN."""
_LEAST_OPENING_RAD, _MOST_OPENING_RAD = np.radians(25.0), np.radians(155.0)
"""Angle between the two edges; a square corner has less than 25 degrees only when the board is
tilted by more than 77 degrees."""
_REMAP_ROWS = 30_000
"""cv2.remap takes at most 32767 rows."""


@dataclass(frozen=True, slots=True)
class SaddlePoints:
    """Points where four alternating sectors meet."""

    points_px: FloatArray
    """(n, 2)."""
    directions_rad: FloatArray
    """(n, 2) angles of the two edges in [0, pi); the second lies clockwise (x right, y down)."""
    polarity: FloatArray
    """(n,) +1 where the sector from the first edge on to the second is bright, else -1."""


def find_saddle_points(image: FloatArray, ring_px: float = 5.0) -> SaddlePoints:
    """Find saddle points of a greyscale image (h, w).

    The determinant of the Hessian is negative at a saddle; a ring about the point must cross
    its mean grey value four times and look the same turned by half.

    >>> image = np.kron(np.indices((4, 4)).sum(axis=0) % 2, np.full((20, 20), 200.0))
    >>> find_saddle_points(image).points_px.round(1).tolist()[:3]
    [[19.5, 19.5], [39.5, 19.5], [59.5, 19.5]]
    """
    blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SMOOTHING_PX)
    smooth = np.asarray(blurred, dtype=np.float32)
    strength = _negative_hessian_determinant(smooth)
    peaks = _peaks(strength, margin=int(ring_px) + 2)
    points = _refine_peaks(strength, peaks)
    return _check_rings(smooth, points, ring_px)


def _negative_hessian_determinant(smooth: FloatArray) -> FloatArray:
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    return np.asarray(xy * xy - xx * yy)


def _peaks(strength: FloatArray, margin: int) -> IntArray:
    """(n, 2) integer pixels of local maxima above a threshold that follows the local light."""
    is_peak = strength == cv2.dilate(strength, np.ones((_PEAK_PX, _PEAK_PX), np.uint8))
    local = cv2.dilate(
        cv2.resize(
            strength, None, fx=_LOCAL_SHRINK, fy=_LOCAL_SHRINK, interpolation=cv2.INTER_AREA
        ),
        np.ones((_LOCAL_CELLS, _LOCAL_CELLS), np.uint8),
    )
    local = cv2.resize(local, (strength.shape[1], strength.shape[0]))
    is_peak &= (strength > _LEAST_LOCAL_SHARE * local) & (strength > _LEAST_STRENGTH)
    is_peak[:margin] = is_peak[-margin:] = False
    is_peak[:, :margin] = is_peak[:, -margin:] = False
    v, u = np.nonzero(is_peak)
    most = min(max(_FEWEST_CANDIDATES, strength.size // _PIXELS_A_CANDIDATE), _MOST_CANDIDATES)
    if len(u) > most:
        strongest = np.argsort(strength[v, u])[-most:]
        u, v = u[strongest], v[strongest]
    return _one_of_equals(np.stack([u, v], axis=1))


def _one_of_equals(peaks: IntArray) -> IntArray:
    """Keep the first of peaks that are equal: a drawn corner between four pixels gives four."""
    if len(peaks) == 0:
        return peaks
    pairs = cKDTree(peaks).query_pairs(_PEAK_PX // 2, p=np.inf, output_type="ndarray")
    return np.delete(peaks, pairs[:, 1], axis=0)


def _refine_peaks(strength: FloatArray, peaks: IntArray) -> FloatArray:
    """Refine by the parabola through the neighbours, at most half a pixel."""
    u, v = peaks[:, 0], peaks[:, 1]
    centre = strength[v, u]
    steps = []
    for before, after in (
        (strength[v, u - 1], strength[v, u + 1]),
        (strength[v - 1, u], strength[v + 1, u]),
    ):
        curvature = np.minimum(before + after - 2.0 * centre, -1e-9)
        steps.append(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
    return np.asarray(peaks + np.stack(steps, axis=1), dtype=float)


def _check_rings(smooth: FloatArray, points: FloatArray, ring_px: float) -> SaddlePoints:
    angles = np.arange(RING_SAMPLES) * (2.0 * np.pi / RING_SAMPLES)
    map_x = (points[:, :1] + ring_px * np.cos(angles)).astype(np.float32)
    map_y = (points[:, 1:] + ring_px * np.sin(angles)).astype(np.float32)
    ring = _sample(smooth, map_x, map_y)
    ring = ring - ring.mean(axis=1, keepdims=True)
    half = RING_SAMPLES // 2
    power = (ring * ring).sum(axis=1) + 1e-9
    symmetry = (ring[:, :half] * ring[:, half:]).sum(axis=1) / (0.5 * power)
    folded = ring[:, :half] + ring[:, half:]  # one period, noise halved
    crossing = (folded > 0.0) != (np.roll(folded, -1, axis=1) > 0.0)
    keep = (symmetry > _LEAST_SYMMETRY) & (crossing.sum(axis=1) == 2)
    keep &= power > RING_SAMPLES * _LEAST_POWER_DN2
    return _edges_of(points[keep], folded[keep], crossing[keep])


def _edges_of(points: FloatArray, folded: FloatArray, crossing: BoolArray) -> SaddlePoints:
    half = RING_SAMPLES // 2
    if len(points) == 0:
        return SaddlePoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    first = np.argmax(crossing, axis=1)
    second = half - 1 - np.argmax(crossing[:, ::-1], axis=1)
    rows = np.arange(len(points))
    angles = []
    for at in (first, second):
        low, high = folded[rows, at], folded[rows, (at + 1) % half]
        angles.append((at + low / (low - high)) * (np.pi / half) % np.pi)
    between = folded[rows, (first + second + 1) // 2]
    directions = np.stack(angles, axis=1)
    polarity = np.where(between > 0, 1.0, -1.0)
    swapped = directions[:, 0] > directions[:, 1]  # the last crossing wrapped past pi
    directions[swapped] = directions[swapped][:, ::-1]
    polarity[swapped] *= -1.0
    opening = directions[:, 1] - directions[:, 0]
    keep = (opening > _LEAST_OPENING_RAD) & (opening < _MOST_OPENING_RAD)
    return SaddlePoints(points[keep], directions[keep], polarity[keep])


def _sample(image: FloatArray, map_x: FloatArray, map_y: FloatArray) -> FloatArray:
    """Bilinear samples, in slices."""
    slices = [slice(at, at + _REMAP_ROWS) for at in range(0, len(map_x), _REMAP_ROWS)]
    parts = [cv2.remap(image, map_x[part], map_y[part], cv2.INTER_LINEAR) for part in slices]
    return np.concatenate(parts) if parts else np.zeros(map_x.shape)
