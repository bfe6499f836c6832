"""Candidates for discs: bright, round, sharply bounded regions at any threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import BoolArray, FloatArray, IntArray
from core.discs.disc_kernels import shrink_image
from core.images import PixelArray

FEW_LEVELS, MANY_LEVELS = 5, 14
"""Thresholds from 8 to 92 % of the grey values' range: steps of 21 and of 6.5 % of it. At least
one lies between a disc and its surroundings if they differ by 21, or by 8 %, of that range."""
_MIN_RADIUS_PX = 2.5
"""Least half axis, px of the image searched. Chosen: a smaller spot is too coarse to have an
outline; a disc of 6 px in diameter is larger."""
_MIN_OUTLINE_PIXELS = 9
"""Pixels of a contour. Chosen: skips specks before an ellipse is fitted; a disc of the least radius
has 11 or more."""
_LOCAL_REACH_PX = 24.0
"""Sigma of the surroundings' weight, px of the image searched. Chosen: about ten least radii;
the grey values themselves are searched as well."""
_LOCAL_FLOOR_DN = 3.0
"""Added to the surroundings' spread. Chosen: above the usual noise of 8-bit images, so that noise
in an even part of the image does not look like contrast."""
# Added to how much the grey values vary along an edge. Chosen: about the noise of an 8-bit
# image, so that an edge without any variation is not infinitely even.
_NOISE_DN = 2.0
_LEAST_CONTOURS, _PIXELS_A_CONTOUR = 500, 4000
"""So many contours are examined at a level, and one more for so many pixels. Chosen: plain
rendered images of a site have at most 7 at a level, a hundredth of that. Clutter was not
measured."""
_BUSY_SHARE = 0.05
"""Of the pixels: with more edges along the rows the small components are dropped first. Noise has
half of them, a grid of 12 px a sixth, plain rendered images of a site 0.002."""
_MOST_REGIONS = 3000
"""Round regions of all levels, the sharpest, among which concentric ones are sought; that takes the
square of their number. A plate has 14 a disc at most."""
_TURNS = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
"""Directions, rad, in which an edge's two sides are compared. Chosen: two for each pixel of
the smallest outline."""


@dataclass(frozen=True, slots=True)
class Blobs:
    """Bright round regions."""

    points_px: FloatArray
    """(n, 2) centres."""
    outline_px: FloatArray
    """(n, 2, 2) symmetric matrix taking the unit circle to the outline."""
    contrast_dn: FloatArray
    """(n,) inside minus outside."""
    evenness: FloatArray
    """(n,) contrast over how much the grey values vary along the edge, inside and outside."""

    @property
    def radius_px(self) -> FloatArray:
        """(n,) mean radius."""
        return np.asarray(np.trace(self.outline_px, axis1=1, axis2=2) / 2.0)

    def select(self, which: BoolArray | IntArray) -> Blobs:
        """Give some of them."""
        return Blobs(
            self.points_px[which],
            self.outline_px[which],
            self.contrast_dn[which],
            self.evenness[which],
        )

    def clearest(self, most: int) -> Blobs:
        """Give the most even ones, at most so many."""
        return self.select(np.sort(np.argsort(-self.evenness, kind="stable")[:most]))


NO_BLOBS = Blobs(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0))
"""Of an image without any."""


def find_blobs(
    pixels: PixelArray,
    shrink: int = 1,
    levels: int = MANY_LEVELS,
    min_contrast_dn: float = 4.0,
    *,
    local: bool = False,
) -> Blobs:
    """Find bright ellipses in a greyscale image (h, w), of axis ratio up to 3.

    Connected regions at several thresholds spread over the grey values; a region counts if its
    area agrees with its outline's ellipse and it is brighter than its surroundings. Of
    concentric regions the one with the sharpest edge stays. The image is searched at 1/shrink
    of its size, where a disc needs a radius of 2.5 px. With local, the thresholds are relative
    to the mean and spread of the surroundings, which shows pale discs beside bright things.
    """
    small = shrink_image(np.ascontiguousarray(pixels), shrink)
    sigma = 1.0 if shrink > 1 else 0.7
    smooth: FloatArray = np.asarray(cv2.GaussianBlur(small, (0, 0), sigma), dtype=np.float32)
    along, across = (cv2.Sobel(smooth, cv2.CV_32F, k, 1 - k, scale=0.125) for k in (0, 1))
    gradient: FloatArray = np.asarray(cv2.magnitude(along, across), dtype=np.float32)
    graded = _relative(smooth) if local else smooth
    found: list[tuple[float, ...]] = []
    for level in _levels(graded, levels):
        found.extend(_round_regions(graded, gradient, level))
    kept = _best_of_concentric(found)
    return _bright_ones(smooth, kept, min_contrast_dn, shrink)


def _relative(smooth: FloatArray) -> FloatArray:
    """Grey values less their local mean, in local standard deviations."""
    size = (0, 0)
    mean = np.asarray(cv2.GaussianBlur(smooth, size, _LOCAL_REACH_PX))
    square = np.asarray(cv2.GaussianBlur(smooth * smooth, size, _LOCAL_REACH_PX))
    spread = np.sqrt(np.maximum(square - mean * mean, 0.0)) + np.float32(_LOCAL_FLOOR_DN)
    return np.asarray((smooth - mean) / spread)


def _levels(graded: FloatArray, count: int) -> FloatArray:
    some = np.sort(graded[::4, ::4], axis=None)
    low, high = some[int(0.005 * len(some))], some[int(0.998 * (len(some) - 1))]
    return np.asarray(low + (high - low) * np.linspace(0.08, 0.92, count))


def _round_regions(
    graded: FloatArray, gradient: FloatArray, level: float
) -> list[tuple[float, ...]]:
    """(x, y, a, b, angle_deg, sharpness) of the round regions above a level."""
    mask = (graded > np.float32(level)).view(np.uint8)
    height, width = graded.shape
    most = _LEAST_CONTOURS + height * width // _PIXELS_A_CONTOUR
    if np.count_nonzero(mask[:, 1:] ^ mask[:, :-1]) > _BUSY_SHARE * mask.size:
        mask = _largest(mask, most)
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    regions: list[tuple[float, ...]] = []
    for k in _longest(contours, most):
        contour = contours[k]
        count = len(contour)
        if count < _MIN_OUTLINE_PIXELS or count > 2 * (width + height):
            continue
        if hierarchy[0, k, 3] >= 0:  # the outline of a hole
            continue
        area = cv2.contourArea(contour) + 0.5 * count
        _, _, w, h = cv2.boundingRect(contour)
        if not 0.35 < area / (0.25 * np.pi * w * h) < 1.4 or max(w, h) > 0.5 * width:
            continue
        (cx, cy), (d1, d2), angle = cv2.fitEllipse(contour)
        a, b = d1 / 2.0 + 0.25, d2 / 2.0 + 0.25
        if min(a, b) < _MIN_RADIUS_PX or max(a, b) > 3.0 * min(a, b):
            continue
        if not 0.85 < area / (np.pi * a * b) < 1.15:
            continue
        edge = np.asarray(contour[:, 0], dtype=np.int64)
        if _fills_ellipse(edge, cx, cy, a, b, angle):
            slopes = np.sort(gradient[edge[:, 1], edge[:, 0]])
            regions.append((cx, cy, a, b, angle, float(slopes[count // 2])))
    return regions


def _largest(mask: NDArray[np.uint8], most: int) -> NDArray[np.uint8]:
    """The mask with its largest disc-like components alone, at most so many.

    What fills its box by far too little or is far too wide has no outline worth its cost.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    _, _, w, h, area = stats.T
    fills = area / (0.25 * np.pi * w * h)
    plausible = (fills > 0.25) & (np.maximum(w, h) <= 0.5 * mask.shape[1])
    plausible[0] = False  # what is below the level
    largest = np.argsort(np.where(plausible, -area, 0), kind="stable")[:most]
    kept = np.zeros(count, dtype=np.uint8)
    kept[largest] = plausible[largest]
    return np.asarray(kept[labels])


def _longest(contours: Sequence[NDArray[Any]], most: int) -> IntArray:
    """Which contours are examined: all, or of very many the longest, in their order.

    Noise, foliage and fine grids have a hundred thousand of them at each level, mostly specks.
    """
    if len(contours) <= most:
        return np.arange(len(contours))
    lengths = np.fromiter(map(len, contours), dtype=np.int64, count=len(contours))
    return np.sort(np.argsort(-lengths, kind="stable")[:most])


def _fills_ellipse(edge: IntArray, cx: float, cy: float, a: float, b: float, angle: float) -> bool:
    """Whether most of the contour lies on the ellipse."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    dx, dy = edge[:, 0] - cx, edge[:, 1] - cy
    rho = np.hypot((c * dx + s * dy) / a, (c * dy - s * dx) / b)
    return bool(np.count_nonzero(np.abs(rho - 1.0) < 1.2 / min(a, b) + 0.05) > 0.8 * len(edge))


def _best_of_concentric(found: list[tuple[float, ...]]) -> FloatArray:
    """(k, 5) x, y, a, b, angle_deg: the sharpest of the regions that share a centre."""
    sharpest = sorted(found, key=lambda region: -region[5])[:_MOST_REGIONS]
    regions = np.array(sharpest).reshape(-1, 6)
    left = np.ones(len(regions), dtype=bool)
    kept = []
    for k, region in enumerate(regions):
        if left[k]:
            away = np.hypot(regions[:, 0] - region[0], regions[:, 1] - region[1])
            left &= away > 0.5 * max(region[2:4].min(), 3.0)
            kept.append(k)
    return np.asarray(regions[kept, :5])


def _bright_ones(
    smooth: FloatArray, ellipses: FloatArray, min_contrast_dn: float, shrink: int
) -> Blobs:
    """Those brighter than their surroundings, at the full image's size."""
    angle = np.radians(ellipses[:, 4])
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = axes[:, :, None] * axes[:, None, :]
    a, b = ellipses[:, 2, None, None], ellipses[:, 3, None, None]
    outline = a * along + b * (np.eye(2) - along)
    contrast, evenness = _contrast(smooth, ellipses[:, :2], outline)
    bright = contrast >= min_contrast_dn
    points = (ellipses[bright, :2] + 0.5) * shrink - 0.5
    return Blobs(points, outline[bright] * shrink, contrast[bright], evenness[bright])


def _contrast(
    smooth: FloatArray, points: FloatArray, outline: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Contrast (k,), DN, zero where a fifth of the edge is reversed, and its evenness (k,)."""
    ring = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1) @ outline
    values = []
    for factor, extra in ((0.75, 0.0), (1.15, 1.5)):
        at = points[:, None] + ring * factor + extra * ring / np.hypot(*ring.T).T[..., None]
        u = np.clip(np.rint(at[..., 0]).astype(int), 0, smooth.shape[1] - 1)
        v = np.clip(np.rint(at[..., 1]).astype(int), 0, smooth.shape[0] - 1)
        values.append(np.sort(smooth[v, u], axis=1))
        if len(values) == 1:
            inside = smooth[v, u]
    fifth_of = len(_TURNS) // 5
    bright, dark = values
    step = np.median(bright, axis=1) - np.median(dark, axis=1)
    reversed_fifth = np.sort(inside - smooth[v, u], axis=1)[:, fifth_of]
    varies = sum(ring[:, -fifth_of - 1] - ring[:, fifth_of] for ring in values)
    return np.where(reversed_fifth > 0, step, 0.0), step / (varies + _NOISE_DN)
