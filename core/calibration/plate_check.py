"""Whether the main target's plate is as drawn: its discs' places, and its scale along x and y.

The displacement is measured by the px between the discs, so a plate drawn wrong makes it wrong.
"""

from __future__ import annotations

import math

import numpy as np

from core.arrays import BoolArray, FloatArray
from core.discs.disc_finder import Discs
from core.discs.disc_mismatch import drawn_outlines
from core.images import GreyImage
from core.rig.compensation import affine
from core.site import CirclesTarget

_FAR_SIGMAS = 3.5
"""As for the other numbers of the config."""
_PLACE_SIGMA = 0.002
"""Of a disc's place, relative to the plate's extent: 0.1 mm of 60 mm, as plates are cut or printed.
One disc so far off makes the scale wrong by 0.05 to 0.1 %."""
_ROUND_SIGMA, _ROUND_SIGMA_PX = 0.005, 0.2
"""Of the ratio of a disc's widths along x and y: as round as discs are cut or printed. What light
and paint add to a width is much the same along both. On rendered plates it is right to 0.0002."""
_MIN_DISCS = 4
"""Three fit any drawing."""
_MIN_DISCS_TO_NAME = 5
"""Of four that are not as drawn, any one may be wrong."""


def plate_problem(image: GreyImage, discs: Discs, target: CirclesTarget) -> str | None:
    """Say what of target.main.centres_mm contradicts the main image (`discs` were found in it).

    None where nothing does, or where too little is seen.
    """
    found = discs.found
    if found.sum() < _MIN_DISCS:
        return None
    return _misplaced(discs, target) or _stretched(image, discs, target)


def _misplaced(discs: Discs, target: CirclesTarget) -> str | None:
    """Discs that are not where they are drawn, seen from the others."""
    found = np.nonzero(discs.found)[0]
    centres_mm, points_px = target.centres_mm[found], discs.points_px[found]
    everything = np.ones(len(found), dtype=bool)
    sigma_mm = _PLACE_SIGMA * float(np.ptp(centres_mm, axis=0).max())
    if _lack_of_fit(centres_mm, points_px, everything) < _FAR_SIGMAS * sigma_mm:
        return None
    likely = [
        _place(centres_mm, points_px, k, found[k] + 1)
        for k in range(len(found))
        if len(found) >= _MIN_DISCS_TO_NAME
        and _lack_of_fit(centres_mm, points_px, everything & (np.arange(len(found)) != k))
        < sigma_mm
    ]
    by_images = f": by the images {', or '.join(likely)}" if likely else ""
    return (
        "target.main.centres_mm (mm, x right, y up): the discs are not at these places"
        f"{by_images}; measure the plate"
    )


def _place(centres_mm: FloatArray, points_px: FloatArray, which: int, number: int) -> str:
    """Where a disc is on the plate, as seen from the others."""
    others = np.arange(len(centres_mm)) != which
    linear, offset = affine(centres_mm[others], points_px[others])
    x_mm, y_mm = np.linalg.solve(linear, points_px[which] - offset)
    drawn_x, drawn_y = centres_mm[which]
    return f"disc {number} is at [{x_mm:.1f}, {y_mm:.1f}], not at [{drawn_x:g}, {drawn_y:g}]"


def _lack_of_fit(centres_mm: FloatArray, points_px: FloatArray, which: BoolArray) -> float:
    """How far, mm, the discs are from where they are drawn, as of one coordinate's sigma.

    What the six numbers of an affine image take up is made up for.
    """
    linear, offset = affine(centres_mm[which], points_px[which])
    free = which.sum() - 3
    if free < 1 or abs(np.linalg.det(linear)) == 0.0:
        return 0.0
    left_px = points_px[which] - centres_mm[which] @ linear.T - offset
    left_mm = np.linalg.solve(linear, left_px.T)
    return math.sqrt(float((left_mm**2).sum()) / (2.0 * free))


def _stretched(image: GreyImage, discs: Discs, target: CirclesTarget) -> str | None:
    """A plate that is drawn too long one way: its discs then are not round."""
    linear = affine(target.centres_mm[discs.found], discs.points_px[discs.found])[0]
    outlines = drawn_outlines(image, discs, target, linear)
    if not len(outlines):
        return None
    x, y = np.median(np.linalg.norm(outlines, axis=2), axis=0)
    width_px = math.sqrt(abs(np.linalg.det(linear))) * float(target.diameters_mm.min())
    sigma = math.hypot(_ROUND_SIGMA, _ROUND_SIGMA_PX / width_px)
    if abs(math.log(x / y)) < _FAR_SIGMAS * sigma:
        return None
    likely = f"all y {x / y:.4g} times as large, or all x {y / x:.4g} times"
    if abs(math.log(x)) > abs(math.log(y)):
        likely = f"all x {y / x:.4g} times as large, or all y {x / y:.4g} times"
    return (
        f"target.main.centres_mm should likely have {likely}: as drawn the discs would be "
        f"{x:.3f} of their width along x and {y:.3f} along y, and they are round; measure the plate"
    )
