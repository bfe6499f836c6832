"""How discs in an image differ from the configured ones: mirrored, turned, of another size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from core.arrays import FloatArray
from core.discs.blobs import Blobs, find_blobs, pyramid
from core.discs.disc_finder import Discs
from core.discs.disc_fit import DiscFits, locate_discs
from core.discs.layout import MIN_DISCS, DiscAssignment, Expectation, Layout, identify_discs
from core.images import GreyImage
from core.site import CirclesTarget

_MOST_SPOTS = 60
"""Spots that may be discs, the clearest. Fewer than when discs are found: 8 layouts are tried."""
_UPRIGHT_DEG, _UPSIDE_DOWN_DEG = 50.0, 130.0
"""Roll of a camera that is still upright, as when discs are found, and of one upside down, 180 - 50
degrees. In between it lies on its side."""
_OTHER_DIAMETERS = (1.0, 1.4, 0.7, 2.0, 0.5, 2.8, 0.35)
"""In units of the configured one, tried in this order. The layout accepts 25 % about each, and
at steps of about sqrt 2 any from 0.35 to 2.8 is within 20 % of the nearest."""
_OTHER_SIZE = 0.1
"""Relative; discs wider or narrower than that for their spacing are drawn so, not only painted or
exposed wider, and a plate as much larger or smaller is no matter of a lens's engraving (2.5 %)."""
_OTHER_BLOB = 0.15
"""The same where discs are seen as spots only, which are some per cent wider than outlines."""
_OUTLINE_STARTS = (1.0, 0.8, 1.25)
"""In units of the configured size: an outline is fitted from within some 15 % of it."""
_EDGE_PX = 1.0
"""What haze and overexposure may add to the width of a disc in an image."""
_ALIKE = 0.2
"""Natural logarithm of the ratio of radii, and of contrasts, within which spots are alike. Chosen;
it decides only what a message says."""


class DiscMismatch(Enum):
    """What is different."""

    SCALE = auto()
    """As configured, but larger or smaller than lens and distance say."""
    UPSIDE_DOWN = auto()
    ON_ITS_SIDE = auto()
    MIRRORED = auto()
    """Left and right are exchanged."""
    FLIPPED = auto()
    """Top and bottom are exchanged."""
    DIAMETER = auto()
    """The centres are as configured, the discs are larger or smaller."""
    LAYOUT = auto()
    """Discs, but not so many or not at these places."""


@dataclass(frozen=True, slots=True)
class SeenDiscs:
    """What is seen instead of the configured target."""

    mismatch: DiscMismatch
    count: int
    """How many discs are seen."""
    px_per_mm: float
    """By the configured centres; NaN with LAYOUT."""
    diameter_ratio: float
    """Of the diameters seen to those configured; NaN with LAYOUT."""


def explain_discs(image: GreyImage, target: CirclesTarget) -> SeenDiscs | None:
    """Say how the discs in an image differ from the configured ones; None where there are none.

    All discs must be seen to be recognised.

    >>> import cv2
    >>> centres_mm = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0]])
    >>> plate = np.full((240, 320), 20, np.uint8)
    >>> for x, y in centres_mm:  # left and right exchanged
    ...     plate = cv2.circle(plate, (int(160 - 6 * x), int(120 - 6 * y)), 24, 200, -1)
    >>> image = GreyImage(cv2.GaussianBlur(plate, (0, 0), 1.0))
    >>> target = CirclesTarget(centres_mm, np.full(4, 8.0), 11000.0, distance_sigma_mm=20.0)
    >>> explain_discs(image, target).mismatch.name
    'MIRRORED'
    """
    blobs, _ = find_blobs(image.pixels, pyramid(image.pixels.shape, 0.0, np.inf))
    blobs = blobs.clearest(_MOST_SPOTS)
    if len(blobs.points_px) < MIN_DISCS:
        return None
    drawn = Layout(target.centres_mm * np.array([1.0, -1.0]), target.diameters_mm / 2.0)
    for ratio in _OTHER_DIAMETERS:
        layout = replace(drawn, radii_mm=ratio * drawn.radii_mm)
        found = _all_found(blobs, layout)
        if found is not None:
            return _as_drawn(image, blobs, layout, found, ratio)
    mirrored = replace(drawn, places_mm=drawn.places_mm * np.array([-1.0, 1.0]))
    found = _all_found(blobs, mirrored)
    if found is not None:
        turned = abs(found.roll_deg) > 90.0
        mismatch = DiscMismatch.FLIPPED if turned else DiscMismatch.MIRRORED
        return SeenDiscs(mismatch, len(found.discs), _px_per_mm(found), 1.0)
    alike = _alike(blobs)
    if alike < MIN_DISCS:
        return None
    return SeenDiscs(DiscMismatch.LAYOUT, alike, np.nan, np.nan)


def doubt_size(
    image: GreyImage, discs: Discs, target: CirclesTarget, expected_px_per_mm: tuple[float, float]
) -> SeenDiscs | None:
    """Say how discs that were found differ in width or scale from the configured ones, if they do.

    expected_px_per_mm: range of the scale by the config. None where they are as configured, or too
    few to tell.
    """
    found = discs.found
    centres_mm = np.column_stack([target.centres_mm[found], np.ones(found.sum())])
    affine, _, rank, _ = np.linalg.lstsq(centres_mm, discs.points_px[found], rcond=None)
    if rank < centres_mm.shape[1]:
        return None
    px_per_mm = float(np.sqrt(abs(np.linalg.det(affine[:2]))))
    ratio = diameter_ratio(image, discs, target, px_per_mm)
    width_px = px_per_mm * float(target.diameters_mm[found].min())
    if abs(np.log(ratio)) > _OTHER_SIZE + _EDGE_PX / width_px:
        return SeenDiscs(DiscMismatch.DIAMETER, int(found.sum()), px_per_mm, ratio)
    low, high = expected_px_per_mm
    if abs(np.log(px_per_mm / np.clip(px_per_mm, low, high))) > _OTHER_SIZE:
        return SeenDiscs(DiscMismatch.SCALE, int(found.sum()), px_per_mm, ratio)
    return None


def diameter_ratio(
    image: GreyImage, discs: Discs, target: CirclesTarget, px_per_mm: float
) -> float:
    """Diameters of the discs that were found by their outlines, to those configured: the median.

    1 where no outline can be fitted.
    """
    nominal_px = 0.5 * target.diameters_mm[discs.found] * px_per_mm
    fits = _located(image, discs, nominal_px)
    return _median_ratio(fits, nominal_px) or 1.0


def drawn_outlines(
    image: GreyImage, discs: Discs, target: CirclesTarget, px_per_mm: FloatArray
) -> FloatArray:
    """(k, 2, 2) outlines of the discs that were found, in units of their drawn radii.

    A matrix takes the unit circle to the outline, on the plate with x right and y up. px_per_mm
    (2, 2) takes places on the plate to the image. Only outlines that can be fitted are given.
    """
    found = discs.found
    radii_mm = 0.5 * target.diameters_mm[found]
    nominal_px = radii_mm * np.sqrt(abs(np.linalg.det(px_per_mm)))
    fits = _located(image, discs, nominal_px)
    outlines = np.linalg.solve(px_per_mm, fits.outline_px) / radii_mm[:, None, None]
    return np.asarray(outlines[fits.usable])


def _located(image: GreyImage, discs: Discs, nominal_px: FloatArray) -> DiscFits:
    """The outlines of the discs that were found, from the first size that leads to some."""
    for start in _OUTLINE_STARTS:
        outline_px = start * nominal_px[:, None, None] * np.eye(2)
        points_px = discs.points_px[discs.found]
        fits = locate_discs(image.pixels, image.saturation_dn, points_px, outline_px)
        if fits.usable.any():
            break
    return fits


def _median_ratio(fits: DiscFits, nominal_px: FloatArray) -> float | None:
    """Radii of fitted outlines to the nominal ones (n,), px; None where no fit can be used."""
    if not fits.usable.any():
        return None
    radius_px = np.sqrt(np.abs(np.linalg.det(fits.outline_px)))
    return float(np.median((radius_px / nominal_px)[fits.usable]))


def _all_found(blobs: Blobs, layout: Layout) -> DiscAssignment | None:
    everything = Expectation(min_discs=len(layout.radii_mm))
    return identify_discs(blobs, layout, everything)


def _as_drawn(
    image: GreyImage, blobs: Blobs, layout: Layout, found: DiscAssignment, ratio: float
) -> SeenDiscs:
    scale = _px_per_mm(found)
    drawn_mm = layout.radii_mm[found.discs] / ratio
    seen = float(np.median(blobs.radius_px[found.spots] / (scale * drawn_mm)))
    if ratio != 1.0:
        mismatch = DiscMismatch.DIAMETER
    elif abs(found.roll_deg) > _UPSIDE_DOWN_DEG:
        mismatch = DiscMismatch.UPSIDE_DOWN
    elif abs(found.roll_deg) > _UPRIGHT_DEG:
        mismatch = DiscMismatch.ON_ITS_SIDE
    elif abs(np.log(seen)) > _OTHER_BLOB:
        mismatch = DiscMismatch.DIAMETER
    else:
        mismatch = DiscMismatch.SCALE
    if mismatch is DiscMismatch.DIAMETER:  # outlines are sharper than spots
        at = found.spots
        fits = locate_discs(
            image.pixels, image.saturation_dn, blobs.points_px[at], blobs.outline_px[at]
        )
        seen = _median_ratio(fits, scale * drawn_mm) or seen
    return SeenDiscs(mismatch, len(found.discs), scale, seen)


def _px_per_mm(found: DiscAssignment) -> float:
    return float(np.sqrt(abs(np.linalg.det(found.H[:2, :2] / found.H[2, 2]))))


def _alike(blobs: Blobs) -> int:
    """How many of the spots are about as large and as bright as the clearest one of them."""
    clearest = int(np.argmax(blobs.evenness))
    size = np.abs(np.log(blobs.radius_px / blobs.radius_px[clearest]))
    bright = np.abs(np.log(blobs.contrast_dn / blobs.contrast_dn[clearest]))
    return int(((size < _ALIKE) & (bright < _ALIKE)).sum())
