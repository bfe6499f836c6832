"""Candidates for discs: bright, round, sharply bounded regions, in a pyramid of the image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.discs.spot_kernels import (
    LEAST_HALF_AXIS_PX,
    MOST_HALF_AXIS_PX,
    find_peaks,
    outline_peaks,
    sharpest_of_concentric,
)
from core.images import PixelArray

_MIN_CONTRAST_DN = 4.0
"""Of a region to its surroundings. Chosen: about twice the noise of 8-bit images."""
# Added to how much the grey values vary along an edge. Chosen: about the noise of an 8-bit
# image, so that an edge without any variation is not infinitely even.
_NOISE_DN = 2.0
_FEWEST_PEAKS, _PIXELS_A_PEAK = 600, 1200
"""So many peaks are outlined, the most even, or one for so many pixels. Chosen: rendered plates
have some tens. This bounds the work on noise, foliage and snow."""
_FEWEST_STEPS, _STEPS_A_PIXEL = 40_000, 0.25
"""So many steps are taken along borders, or so many for each pixel. Chosen: a round spot takes a
hundred at all levels, so that all peaks can be outlined if a half of them is round."""
_BLUR_PX, _FULL_SIZE_BLUR_PX = 1.0, 0.7
"""1 sigma, px of the image searched: against noise. Chosen: less than half of the least half axis;
the lens has blurred the full image already."""
_MOST_REGIONS = 2000
"""Round regions, the sharpest, among which concentric ones are sought; that takes the
square of their number. A plate has some at each size that is searched."""
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
        """Give the most even ones of each size, a factor of two, at most so many in all.

        So a thousand snowflakes do not displace a plate whose discs are larger.
        """
        order = np.argsort(-self.evenness, kind="stable")
        size = np.floor(np.log2(self.radius_px[order])).astype(np.int64)
        rank = np.zeros(len(order), dtype=np.int64)
        for each in np.unique(size):
            rank[size == each] = np.arange(np.count_nonzero(size == each))
        return self.select(np.sort(order[np.argsort(rank, kind="stable")[:most]]))


NO_BLOBS = Blobs(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0))
"""Of an image without any."""


@dataclass(frozen=True, slots=True)
class Work:
    """What a search has cost, in units that do not depend on the machine."""

    pixels: int = 0
    """Of all images looked through, each at its own size."""
    peaks: int = 0
    """Outlined at six levels or fewer."""
    border_steps: int = 0
    """Pixels followed along their borders."""

    def __add__(self, other: Work) -> Work:
        """Both."""
        return Work(
            self.pixels + other.pixels,
            self.peaks + other.peaks,
            self.border_steps + other.border_steps,
        )


def pyramid(shape: tuple[int, ...], least_radius_px: float, most_radius_px: float) -> list[int]:
    """By how much to shrink an image (h, w) to find discs of these radii, the smallest image first.

    >>> pyramid((1200, 1920), 0.0, np.inf), pyramid((1200, 1920), 20.0, 30.0)
    ([64, 32, 16, 8, 4, 2, 1], [8, 4, 2])
    """
    shrinks = []
    shrink = 1
    while min(shape) // shrink > 4 * LEAST_HALF_AXIS_PX or shrink == 1:
        finds = LEAST_HALF_AXIS_PX * shrink <= most_radius_px
        if finds and MOST_HALF_AXIS_PX * shrink >= least_radius_px:
            shrinks.append(shrink)
        shrink *= 2
    return shrinks[::-1]


def find_blobs(pixels: PixelArray, shrinks: Sequence[int]) -> tuple[Blobs, Work]:
    """Find bright ellipses in a greyscale image (h, w), of axis ratio up to 3.

    In the image at each 1/shrink of its size, peaks that are brighter than what is about them on
    most sides are outlined at levels between the two, and the sharpest outline that
    is an ellipse stays; its shorter half axis is between 2.5 and 12 px there. Also gives what the
    search has cost: it is bounded by the number of pixels, whatever they show.
    """
    parts: list[Blobs] = []
    sharpness: list[FloatArray] = []
    work = Work()
    for shrink, smooth, finer in _shrunk(pixels, shrinks):
        blobs, sharp, cost = _blobs_at(smooth, finer, shrink)
        parts.append(blobs)
        sharpness.append(sharp)
        work += cost
    if not parts:
        return NO_BLOBS, work
    blobs = join_blobs(parts)
    order = np.argsort(-np.concatenate(sharpness), kind="stable")[:_MOST_REGIONS]
    blobs = blobs.select(order)
    size = np.ascontiguousarray(np.linalg.eigvalsh(blobs.outline_px)[:, 0])  # as compiled
    alone = sharpest_of_concentric(blobs.points_px, size)
    return blobs.select(alone), work


def join_blobs(parts: Sequence[Blobs]) -> Blobs:
    """All of them."""
    return Blobs(
        np.concatenate([part.points_px for part in parts]),
        np.concatenate([part.outline_px for part in parts]),
        np.concatenate([part.contrast_dn for part in parts]),
        np.concatenate([part.evenness for part in parts]),
    )


def _shrunk(
    pixels: PixelArray, shrinks: Sequence[int]
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Images at 1/shrink of the size, blurred a little, float32, each with the one before it.

    By means of blocks; what is left over at the far borders is dropped. The largest comes first.
    """
    small: FloatArray = np.asarray(pixels, dtype=np.float32)
    shrink, finer = 1, None
    while shrinks and shrink <= max(shrinks):
        smooth = None
        if shrink in shrinks or 2 * shrink in shrinks:
            sigma = _BLUR_PX if shrink > 1 else _FULL_SIZE_BLUR_PX
            smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), sigma), dtype=np.float32)
        if shrink in shrinks and smooth is not None:
            yield shrink, smooth, smooth if finer is None else finer
        height, width = small.shape[0] // 2, small.shape[1] // 2
        even = small[: 2 * height, : 2 * width]
        small = np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA))
        shrink, finer = 2 * shrink, smooth


def _blobs_at(smooth: FloatArray, finer: FloatArray, shrink: int) -> tuple[Blobs, FloatArray, Work]:
    """Blobs of a size, the gradient (n,) at their edges, DN per px of the whole image, the cost."""
    peaks = find_peaks(smooth, _MIN_CONTRAST_DN, _NOISE_DN)
    most = max(_FEWEST_PEAKS, smooth.size // _PIXELS_A_PEAK)
    peaks = peaks[np.argsort(-peaks[:, 2], kind="stable")[:most]]
    most_steps = max(_FEWEST_STEPS, int(_STEPS_A_PIXEL * smooth.size))
    regions, steps = outline_peaks(smooth, peaks, most_steps)
    blobs, bright = _bright_ones(finer, regions, shrink)
    return blobs, regions[bright, 5] / shrink, Work(smooth.size, len(peaks), steps)


def _bright_ones(finer: FloatArray, regions: FloatArray, shrink: int) -> tuple[Blobs, BoolArray]:
    """Those brighter than their surroundings, at the full image's size, and which these are."""
    angle = regions[:, 4]
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = axes[:, :, None] * axes[:, None, :]
    a, b = regions[:, 2, None, None], regions[:, 3, None, None]
    outline = shrink * (a * along + b * (np.eye(2) - along))
    points = (regions[:, :2] + 0.5) * shrink - 0.5
    half = max(1, shrink // 2)
    contrast, evenness = _contrast(finer, (points + 0.5) / half - 0.5, outline / half)
    bright = contrast >= _MIN_CONTRAST_DN
    return Blobs(points[bright], outline[bright], contrast[bright], evenness[bright]), bright


def _contrast(
    smooth: FloatArray, points: FloatArray, outline: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Contrast (k,), DN, zero where a fifth of the edge is reversed, and its evenness (k,)."""
    ring = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1) @ outline
    outward = ring / np.hypot(ring[..., 0], ring[..., 1])[..., None]
    inside = _grey_at(smooth, points[:, None] + 0.75 * ring)
    outside = _grey_at(smooth, points[:, None] + 1.15 * ring + 1.5 * outward)
    fifth_of, middle = len(_TURNS) // 5, len(_TURNS) // 2
    reversed_fifth = np.partition(inside - outside, fifth_of, axis=1)[:, fifth_of]
    step, varies = np.zeros(len(points)), np.zeros(len(points))
    for grey, sign in ((inside, 1.0), (outside, -1.0)):
        grey.sort(axis=1)
        step += sign * 0.5 * (grey[:, middle - 1] + grey[:, middle])
        varies += grey[:, -fifth_of - 1] - grey[:, fifth_of]
    return np.where(reversed_fifth > 0, step, 0.0), step / (varies + _NOISE_DN)


def _grey_at(smooth: FloatArray, points: FloatArray) -> FloatArray:
    """Grey values at the nearest pixels (k, turns)."""
    u = np.clip(np.rint(points[..., 0]).astype(int), 0, smooth.shape[1] - 1)
    v = np.clip(np.rint(points[..., 1]).astype(int), 0, smooth.shape[0] - 1)
    return np.asarray(smooth[v, u])
