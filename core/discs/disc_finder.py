"""The main target: discs found in an image, named by their layout, located to sub-pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.discs.blobs import FEW_LEVELS, MANY_LEVELS, NO_BLOBS, Blobs, find_blobs
from core.discs.disc_fit import DiscFits, locate_discs
from core.discs.layout import (
    MIN_DISCS,
    SCALE_TOLERANCE,
    DiscAssignment,
    Expectation,
    Layout,
    identify_discs,
)
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.site import CirclesTarget

__all__ = ["MIN_DISCS", "Discs", "find_discs"]

_MAX_ROLL_DEG = 50.0
"""How far the camera may be rolled. Chosen: it is mounted upright to some degrees, and beyond 90
degrees an X of discs would be named upside down."""
_MIN_CLEAN = 0.5
"""Least explained fraction of a disc that is used. Chosen: half an outline still determines an
ellipse, and a row is flagged below 0.95."""
_MOST_CANDIDATES = 60
"""Spots that may be discs, the clearest. Chosen as a bound on the work, which grows with its
square; a target has a few."""
_QUICK_RADIUS_PX, _SEARCH_RADIUS_PX = 9.0, 7.0
"""Radius, px, to which the smallest disc may be shrunk: at the scale expected, then at the smallest
scale allowed. At that scale the quick look still leaves it 4.5 px, and a spot needs 2.5."""
_LARGE_PX = 1000
"""Longer side above which an image is halved where no scale is expected. Chosen for speed: a
disc then needs a radius of 5 px."""


@dataclass(frozen=True, slots=True)
class Discs:
    """The target's discs in one image."""

    found: BoolArray
    """(n,), in the order of the target's centres."""
    points_px: FloatArray
    """(n, 2), NaN where not found."""
    covariance_px2: FloatArray
    """(n, 2, 2), NaN where not found."""
    explained_fraction: FloatArray
    """(n,) share of each outline's pixels that look like a disc's."""
    contrast_dn: float
    blur_px: float


def find_discs(
    image: GreyImage,
    target: CirclesTarget,
    expected_px_per_mm: float | None = None,
    expected_px: FloatArray | None = None,
) -> Discs:
    """Find the main target in an image.

    At least three discs are needed. expected_px_per_mm, where known, refuses other sizes (by a
    factor of two); expected_px (n, 2), NaN where unknown, are the discs' predicted places,
    which decide between layouts that look alike. The camera is upright to within 50 degrees.
    The points are the middles of the outlines. Raises TargetNotFoundError.

    >>> import cv2
    >>> centres_mm = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0]])
    >>> target = CirclesTarget(centres_mm, np.full(4, 8.0), 11000.0, distance_sigma_mm=20.0)
    >>> plate = np.full((240, 320), 20, np.uint8)
    >>> for x, y in centres_mm:
    ...     plate = cv2.circle(plate, (int(160 + 6 * x), int(120 - 6 * y)), 24, 200, -1)
    >>> seen = find_discs(GreyImage(cv2.GaussianBlur(plate, (0, 0), 1.0)), target, 6.0)
    >>> seen.points_px.round(1).tolist()
    [[70.0, 54.0], [250.0, 54.0], [160.0, 120.0], [70.0, 186.0]]
    """
    layout = Layout(target.centres_mm * np.array([1.0, -1.0]), target.diameters_mm / 2.0)
    expected = Expectation(
        expected_px_per_mm, expected_px, upright_deg=_MAX_ROLL_DEG, max_roll_deg=_MAX_ROLL_DEG
    )
    blobs, assignment = _search(image, layout, expected)
    n = len(target.centres_mm)
    if assignment is None:
        msg = (
            f"main target: fewer than {MIN_DISCS} of {n} discs found "
            f"({len(blobs.points_px)} round bright spots in the image), {MIN_DISCS} are needed"
        )
        raise TargetNotFoundError(msg)
    if not assignment.unambiguous:
        msg = "main target: its discs can be named in more than one way"
        raise TargetNotFoundError(msg)
    at, which = assignment.spots, assignment.discs
    fits = locate_discs(
        image.pixels, image.saturation_dn, blobs.points_px[at], blobs.outline_px[at]
    )
    good = clear_fits(fits)
    if good.sum() < MIN_DISCS:
        msg = f"main target: only {int(good.sum())} of {n} discs are clear enough to measure"
        raise TargetNotFoundError(msg)
    found = np.zeros(n, dtype=bool)
    points, covariance, explained_fraction = (
        np.full((n, 2), np.nan),
        np.full((n, 2, 2), np.nan),
        np.zeros(n),
    )
    found[which[good]] = True
    points[which[good]] = fits.points_px[good]
    covariance[which[good]] = fits.covariance_px2[good]
    explained_fraction[which] = fits.explained_fraction
    return Discs(
        found,
        points,
        covariance,
        explained_fraction,
        float(np.median(fits.contrast_dn[good])),
        float(np.median(fits.blur_px[good])),
    )


def clear_fits(fits: DiscFits) -> BoolArray:
    """Which discs (n,) stand out from the noise and look like discs for most of their outline."""
    good = fits.usable & (fits.explained_fraction > _MIN_CLEAN)
    return np.asarray(good & (fits.contrast_dn > 4.0 * fits.noise_dn / np.sqrt(10.0)))


def _search(
    image: GreyImage, layout: Layout, expected: Expectation
) -> tuple[Blobs, DiscAssignment | None]:
    """Look quickly at the size expected; where a disc is missing, thoroughly."""
    blobs, assignment = NO_BLOBS, None
    for shrink, levels in _stages(image, layout, expected):
        seen = _candidates(find_blobs(image.pixels, shrink, levels), layout, expected)
        named = identify_discs(seen, layout, expected) if len(seen.points_px) >= MIN_DISCS else None
        if assignment is None or (named is not None and len(named.discs) > len(assignment.discs)):
            blobs, assignment = seen, named
        if assignment is not None and len(assignment.discs) == len(layout.radii_mm):
            break
    return blobs, assignment


def _stages(image: GreyImage, layout: Layout, expected: Expectation) -> list[tuple[int, int]]:
    """By how much to shrink the image, and the number of levels to try."""
    if expected.px_per_mm is None:
        return [(2 if max(image.pixels.shape) > _LARGE_PX else 1, MANY_LEVELS)]
    radius = float(layout.radii_mm.min()) * expected.px_per_mm
    quick = max(1, int(radius / _QUICK_RADIUS_PX))
    thorough = max(1, int(radius / SCALE_TOLERANCE / _SEARCH_RADIUS_PX))
    return [(quick, FEW_LEVELS), (thorough, MANY_LEVELS)]


def _candidates(blobs: Blobs, layout: Layout, expected: Expectation) -> Blobs:
    """Round bright spots of a size that a disc may have; the clearest of them."""
    if expected.px_per_mm is not None:
        radii = layout.radii_mm * expected.px_per_mm
        fits = blobs.radius_px > 0.8 * radii.min() / SCALE_TOLERANCE
        fits &= blobs.radius_px < 1.25 * radii.max() * SCALE_TOLERANCE
        blobs = blobs.select(fits)
    return blobs.clearest(_MOST_CANDIDATES)
