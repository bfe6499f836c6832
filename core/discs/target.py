"""A plate of white discs found in any image, by its layout alone: for use without the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.discs.blobs import Blobs
from core.discs.disc_fit import DiscFits, locate_discs
from core.discs.layout import MIN_DISCS, DiscAssignment, Expectation, Layout
from core.discs.search import clear_fits, search_plate
from core.errors import ImageError, TargetNotFoundError
from core.geometry.homography import circle_outlines, outline_offset, refine_on_circles
from core.images import GreyImage, PixelArray

_POINT_SIGMA_PX = 0.05
"""Of a fitted disc's place when the homography is refined. Chosen: well above its noise, some
thousandths of a px, as lens and plate are not ideal."""
_PLACE_SHARE, _PLACE_PX = 0.01, 0.5
"""How far a fitted disc may be from where the others put it: this share of the target's size in the
image plus so many px. Chosen: the sigma of places in the layout, and half a pixel for small
targets."""
_OUTLINE_SHARE, _OUTLINE_PX = 0.12, 0.5
"""How far an outline may be from the one expected: this share of its radius plus so many px plus
the blur. Chosen: wider than the sigma of 7 % in the layout."""
_OTHER_SIZE = 1.3
"""Largest factor, either way, between diameters seen and stated. Chosen: what the layout accepts
when it names them, exp(0.25) = 1.28, rounded up."""
_ROUNDS = 3
"""Of homography and choice of discs. Chosen: each may drop discs that were in the fit before."""


@dataclass(frozen=True, slots=True)
class FoundTarget:
    """A plate's discs in one image; the k-th is that of the k-th centre given."""

    found: BoolArray
    """(n,)."""
    points_px: FloatArray
    """(n, 2) images of the discs' centres, NaN where not found."""
    covariance_px2: FloatArray
    """(n, 2, 2) from the image's noise, NaN where not found."""
    explained_fraction: FloatArray
    """(n,) share of each outline's pixels that look like a disc's; 0 where not found."""
    H: FloatArray
    """(3, 3) homography: `[u v 1]' ~ H [x y 1]'`, x and y as the centres, mm."""
    roll_deg: float
    """How far the plate is turned clockwise in the image."""
    contrast_dn: float
    blur_px: float


def find_target(
    image: GreyImage | PixelArray,
    centres_mm: FloatArray,
    diameter_mm: float | FloatArray,
    *,
    scale_px_per_mm: float | None = None,
    near: FloatArray | None = None,
    max_roll_deg: float = 180.0,
) -> FoundTarget:
    """Find white discs on a black plate in a greyscale image, whatever else it shows.

    image: (h, w) uint8 or uint16, or a GreyImage, which says how many bits are used. centres_mm
    (n, 2), n at least 3: x right, y up; diameter_mm: one for all discs or one each. The scale,
    the turn and the tilt (to some 60 degrees) need not be known. scale_px_per_mm, if given, is
    right to a factor of two; max_roll_deg is how far the plate may be turned in the image, either
    way.

    A layout that looks the same when turned (an X of equal discs) is taken to be upright to
    within 45 degrees, unless near (n, 2), px, says where the discs were in an image before, NaN
    where unknown. Four discs must be seen, of a layout of three or with scale or near three.

    The points are the images of the discs' centres: under perspective the middle of an ellipse
    is not, and the difference is taken off (as far as four discs or more tell it).

    Raises TargetNotFoundError if the plate is not seen or its discs cannot be distinguished for
    certain, ImageError if the array is no greyscale image, ValueError for a layout that is none.

    >>> import cv2
    >>> centres_mm = np.array([[-15, 11], [15, 11], [0, 0], [-15, -11], [15, -11]])
    >>> plate = np.full((240, 320), 20, np.uint8)
    >>> for x, y in centres_mm:
    ...     plate = cv2.circle(plate, (int(160 + 6 * x), int(120 - 6 * y)), 24, 200, -1)
    >>> seen = find_target(cv2.GaussianBlur(plate, (0, 0), 1.0), centres_mm, 8.0)
    >>> seen.points_px[:2].round(1).tolist(), seen.found.tolist()
    ([[70.0, 54.0], [250.0, 54.0]], [True, True, True, True, True])
    """
    grey = _as_grey(image)
    layout = _as_layout(centres_mm, diameter_mm)
    known = scale_px_per_mm is not None or near is not None
    least = MIN_DISCS if known else min(len(layout.radii_mm), MIN_DISCS + 1)
    expected = Expectation(scale_px_per_mm, near, max_roll_deg=max_roll_deg, min_discs=least)
    blobs, assignment = _search(grey, layout, expected)
    fits, which, H = _locate(grey, layout, blobs, assignment)
    if len(which) < least:
        msg = f"main target: only {len(which)} of {len(layout.radii_mm)} discs are clear enough"
        raise TargetNotFoundError(msg)
    return _as_found(fits, which, H, layout, assignment)


def _as_grey(image: GreyImage | PixelArray) -> GreyImage:
    grey = image if isinstance(image, GreyImage) else GreyImage(image, 8 * image.itemsize)
    if grey.pixels.ndim != 2 or grey.pixels.dtype not in {np.dtype("u1"), np.dtype("u2")}:
        msg = (
            f"image: greyscale uint8 or uint16 (h, w) is needed, this is {grey.pixels.dtype} of "
            f"shape {grey.pixels.shape}; convert it first"
        )
        raise ImageError(msg)
    return grey


def _as_layout(centres_mm: FloatArray, diameter_mm: float | FloatArray) -> Layout:
    centres = np.asarray(centres_mm, dtype=float)
    if centres.ndim != 2 or centres.shape[1] != 2 or len(centres) < MIN_DISCS:
        msg = f"centres_mm: at least {MIN_DISCS} rows of x, y are needed, not {centres.shape}"
        raise ValueError(msg)
    diameters = np.asarray(diameter_mm, dtype=float)
    if diameters.shape not in {(), (1,), (len(centres),)} or not (diameters > 0).all():
        msg = f"diameter_mm: one positive value, or one for each of {len(centres)} discs"
        raise ValueError(msg)
    layout = Layout(centres * np.array([1.0, -1.0]), np.ones(len(centres)) * diameters / 2.0)
    if layout.spacing_mm <= 2.0 * layout.radii_mm.min():
        msg = "centres_mm: discs overlap; are centres and diameters in the same unit?"
        raise ValueError(msg)
    return layout


def _search(grey: GreyImage, layout: Layout, expected: Expectation) -> tuple[Blobs, DiscAssignment]:
    """Find the spots that are the discs."""
    seen = search_plate(grey, layout, expected)
    if seen.assignment is None:
        msg = (
            f"main target: no {expected.min_discs} of {len(layout.radii_mm)} discs found as they "
            f"are laid out ({seen.most_spots} round bright spots in the image)"
        )
        raise TargetNotFoundError(msg)
    if not seen.assignment.unambiguous:
        msg = (
            "main target: its discs can be named in more than one way; "
            "say where they are about (near)"
        )
        raise TargetNotFoundError(msg)
    return seen.blobs, seen.assignment


def _locate(
    grey: GreyImage, layout: Layout, blobs: Blobs, assignment: DiscAssignment
) -> tuple[DiscFits, IntArray, FloatArray]:
    """Fit all discs, where they were seen or should be; keep those that are where they should."""
    H = assignment.H
    points, outline = circle_outlines(H, layout.places_mm, layout.radii_mm)
    points[assignment.discs] = blobs.points_px[assignment.spots]
    outline[assignment.discs] = blobs.outline_px[assignment.spots]
    fits = locate_discs(grey.pixels, grey.saturation_dn, points, outline)
    good = clear_fits(fits)
    radii = _radii_seen(H, layout, fits, good)
    for _ in range(_ROUNDS):
        which = np.flatnonzero(good)
        if len(which) < MIN_DISCS:
            break
        H = refine_on_circles(
            H,
            layout.places_mm[which],
            radii[which],
            fits.points_px[which],
            fits.outline_px[which],
            _POINT_SIGMA_PX,
        )
        middles, outline = circle_outlines(H, layout.places_mm, radii)
        miss = np.hypot(*(fits.points_px - middles).T)
        extent = float(np.ptp(fits.points_px[which], axis=0).max())
        fits_plate = miss < _PLACE_SHARE * extent + _PLACE_PX
        good = good & fits_plate & _as_wide(outline, fits)
    return fits, np.flatnonzero(good), H


def _radii_seen(H: FloatArray, layout: Layout, fits: DiscFits, good: BoolArray) -> FloatArray:
    """Radii (n,) of the discs, mm, as they are seen where three or more of a size agree on it.

    Overexposed discs grow, the paper around them shrinks, and the wrong diameter may be stated.
    """
    _, outline = circle_outlines(H, layout.places_mm, layout.radii_mm)
    ratio = np.trace(fits.outline_px, axis1=1, axis2=2) / np.trace(outline, axis1=1, axis2=2)
    radii = layout.radii_mm.copy()
    for radius in np.unique(layout.radii_mm):
        alike = layout.radii_mm == radius
        if (alike & good).sum() >= MIN_DISCS:
            seen = float(np.median(ratio[alike & good]))
            radii[alike] *= np.clip(seen, 1.0 / _OTHER_SIZE, _OTHER_SIZE)
    return radii


def _as_wide(outline: FloatArray, fits: DiscFits) -> BoolArray:
    """Whether the outlines seen are as wide as they should be, as far as their blur tells."""
    radius = np.trace(outline, axis1=1, axis2=2) / 2.0
    difference = np.abs(np.linalg.eigvalsh(fits.outline_px - outline)).max(axis=1)
    return np.asarray(difference < _OUTLINE_SHARE * radius + _OUTLINE_PX + fits.blur_px)


def _as_found(
    fits: DiscFits, which: IntArray, H: FloatArray, layout: Layout, assignment: DiscAssignment
) -> FoundTarget:
    n = len(layout.radii_mm)
    found = np.zeros(n, dtype=bool)
    found[which] = True
    offset = outline_offset(H, layout.places_mm, layout.radii_mm)
    return FoundTarget(
        found,
        np.where(found[:, None], fits.points_px - offset, np.nan),
        np.where(found[:, None, None], fits.covariance_px2, np.nan),
        np.where(found, fits.explained_fraction, 0.0),
        H @ np.diag([1.0, -1.0, 1.0]),
        assignment.roll_deg,
        float(np.median(fits.contrast_dn[which])),
        float(np.median(fits.blur_px[which])),
    )
