"""The search for a plate of discs: one for all who look for it, with one bound on its work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.discs.blobs import NO_BLOBS, Blobs, Work, find_blobs, join_blobs, pyramid
from core.discs.disc_fit import DiscFits
from core.discs.layout import (
    MIN_DISCS,
    SCALE_TOLERANCE,
    DiscAssignment,
    Expectation,
    Layout,
    identify_discs,
)
from core.images import GreyImage

_MIN_CLEAN = 0.5
"""Least explained fraction of a disc that is used. Chosen: half an outline still determines an
ellipse, and a row is flagged below 0.95."""
MOST_SPOTS = 100
"""Spots that may be discs, the clearest. Chosen as a bound on the work, which grows with its
square; a target has a few."""
_FIRST_SIZE_PX = 1000
"""Longer side of the largest image that is searched at first where no scale is expected; smaller
discs are sought later. For speed."""


@dataclass(frozen=True, slots=True)
class Search:
    """What a search has found."""

    blobs: Blobs
    """Spots that may be discs."""
    assignment: DiscAssignment | None
    """Which of them are; None where no naming fits."""
    most_spots: int
    """Of one look."""
    work: Work


def search_plate(image: GreyImage, layout: Layout, expected: Expectation) -> Search:
    """Look ever more thoroughly until all discs are named for certain; give the best naming.

    Each size of the image is looked through once, so that the work is bounded by its pixels.
    """
    best: tuple[Blobs, DiscAssignment] | None = None
    seen, spots, work = NO_BLOBS, 0, Work()
    radii_px = None if expected.px_per_mm is None else layout.radii_mm * expected.px_per_mm
    for shrinks in looks(image, radii_px):
        found, cost = find_blobs(image.pixels, shrinks)
        work += cost
        seen = join_blobs([seen, found])
        blobs = plausible_spots(seen, radii_px).clearest(MOST_SPOTS)
        spots = max(spots, len(blobs.points_px))
        if len(blobs.points_px) < MIN_DISCS:
            continue
        assignment = identify_discs(blobs, layout, expected)
        if assignment is None:
            continue
        if best is None or assignment.cost < best[1].cost:
            best = blobs, assignment
        if len(assignment.discs) == len(layout.radii_mm) and assignment.unambiguous:
            break
    if best is None:
        return Search(seen, None, spots, work)
    return Search(*best, spots, work)


def clear_fits(fits: DiscFits) -> BoolArray:
    """Which discs (n,) stand out from the noise and look like discs for most of their outline."""
    good = fits.usable & (fits.explained_fraction > _MIN_CLEAN)
    return np.asarray(good & (fits.contrast_dn > 4.0 * fits.noise_dn / np.sqrt(10.0)))


def looks(image: GreyImage, radii_px: FloatArray | None) -> Iterator[list[int]]:
    """By how much to shrink the image, look by look, for discs (n,) of about these radii."""
    shape = image.pixels.shape
    if radii_px is None:
        shrinks = pyramid(shape, 0.0, np.inf)
        least = -(-max(shape) // _FIRST_SIZE_PX)
        coarse = [shrink for shrink in shrinks if shrink >= least]
    else:
        shrinks = pyramid(shape, *_radius_limits_px(radii_px))
        coarse = [shrink for shrink in shrinks if float(radii_px.min()) >= 4.0 * shrink]
    if coarse:
        yield coarse
    fine = [shrink for shrink in shrinks if shrink not in coarse]
    if fine:
        yield fine


def plausible_spots(blobs: Blobs, radii_px: FloatArray | None) -> Blobs:
    """Those of a size that a disc may have."""
    return blobs if radii_px is None else blobs.select(is_plausible(blobs, radii_px))


def is_plausible(blobs: Blobs, radii_px: FloatArray) -> BoolArray:
    """Whether each spot is of a size that a disc may have."""
    least_px, most_px = _radius_limits_px(radii_px)
    return np.asarray((blobs.radius_px > least_px) & (blobs.radius_px < most_px))


def _radius_limits_px(radii_px: FloatArray) -> tuple[float, float]:
    """How small and how large a spot may be, for discs of about these radii.

    Besides the scale, the outline of a spot may be off by a quarter.
    """
    least_px, most_px = float(radii_px.min()), float(radii_px.max())
    return 0.8 * least_px / SCALE_TOLERANCE, 1.25 * most_px * SCALE_TOLERANCE
