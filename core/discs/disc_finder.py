"""The main target: discs found in an image, named by their layout, located to sub-pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.discs.blobs import Blobs
from core.discs.disc_fit import locate_discs
from core.discs.layout import MIN_DISCS, DiscAssignment, Expectation, Layout
from core.discs.search import clear_fits, search_plate
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.site import CirclesTarget

__all__ = ["MIN_DISCS", "Discs", "find_discs"]

_MAX_ROLL_DEG = 50.0
"""How far the camera may be rolled. Chosen: it is mounted upright to some degrees, and beyond 90
degrees an X of discs would be named upside down."""


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
    seen = search_plate(image, layout_of(target), expectation(expected_px_per_mm, expected_px))
    blobs, assignment = seen.blobs, seen.assignment
    n = len(target.centres_mm)
    if assignment is None:
        msg = (
            f"main target: fewer than {MIN_DISCS} of {n} discs found "
            f"({seen.most_spots} round bright spots in the image), {MIN_DISCS} are needed"
        )
        raise TargetNotFoundError(msg)
    if not assignment.unambiguous:
        msg = "main target: its discs can be named in more than one way"
        raise TargetNotFoundError(msg)
    return locate_assigned(image, target, blobs, assignment)


def layout_of(target: CirclesTarget) -> Layout:
    """The discs as the image shows them, y down."""
    return Layout(target.centres_mm * np.array([1.0, -1.0]), target.diameters_mm / 2.0)


def expectation(px_per_mm: float | None, near_px: FloatArray | None = None) -> Expectation:
    """What is known before looking with a camera that is mounted upright."""
    return Expectation(px_per_mm, near_px, upright_deg=_MAX_ROLL_DEG, max_roll_deg=_MAX_ROLL_DEG)


def locate_assigned(
    image: GreyImage, target: CirclesTarget, blobs: Blobs, assignment: DiscAssignment
) -> Discs:
    """Locate the discs of a target among spots that have been named.

    Raises TargetNotFoundError if fewer than three are clear.
    """
    n = len(target.centres_mm)
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
