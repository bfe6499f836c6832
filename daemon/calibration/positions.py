"""Where the head goes during a calibration, and in which order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.discs.disc_finder import Discs
from core.errors import CalibrationError
from core.site import Site

PAN_POSITIONS, TILT_POSITIONS = 7, 3
"""21 positions, as in the paper."""
ZERO_RETURNS = 2
"""The zero is seen again half-way and at the end: what moved by itself meanwhile shows there."""
VIEWS = PAN_POSITIONS * TILT_POSITIONS + ZERO_RETURNS
REACH = 0.8
"""Share of the way to where the main target would touch the edge of its image."""
MAX_ANGLE_DEG = 1.0
"""A wide main image would allow more, but the drift to be corrected is a tenth of a degree."""
MIN_ANGLE_DEG = 0.03
"""Half a milliradian: less would not tell the model from the noise."""

Position = tuple[float, float]
"""Pan and tilt, degrees from the head's zero."""
ZERO: Position = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Limits:
    """How far the head may go either way, degrees."""

    pan_deg: float
    tilt_deg: float


def room_px(site: Site, discs: Discs) -> FloatArray:
    """How far (2,) the main target can go in its image, u and v, in the worse direction, px."""
    seen = discs.found
    radius = float(np.nanmax(site.main_target.diameters_mm)) * site.nominal_px_per_mm
    points = discs.points_px[seen]
    size = np.array([site.main.width_px, site.main.height_px], dtype=float)
    low, high = points.min(axis=0) - radius, size - 1.0 - points.max(axis=0) - radius
    return np.asarray(np.maximum(np.minimum(low, high), 0.0))


def planned_positions(site: Site, discs: Discs, limits: Limits) -> list[Position]:
    """Give the positions of the rig views: a grid that keeps the main target in the image.

    Every second one of the grid first and the others after, so that time and angle go together
    nowhere: a drift shows in the residuals, and does not pass for a property of the rig. The
    zero comes again half-way and at the end. Raises CalibrationError where the target or the
    head leaves too little room.
    """
    free = np.degrees(REACH * room_px(site, discs) / site.main.focal_px)
    reach = np.minimum(np.minimum(free, [limits.pan_deg, limits.tilt_deg]), MAX_ANGLE_DEG)
    for axis, angle, wanted in zip(("pan", "tilt"), reach, free, strict=True):
        if angle < MIN_ANGLE_DEG:
            cure = (
                "aim the main camera so that its target is in the middle of the image"
                if wanted < MIN_ANGLE_DEG
                else "widen the head's limits"
            )
            msg = (
                f"calibration: only {angle:.3f} deg of {axis} either way, {MIN_ANGLE_DEG} deg "
                f"are needed; {cure}"
            )
            raise CalibrationError(msg)
    grid = _serpentine(float(reach[0]), float(reach[1]))
    return [*grid[::2], ZERO, *grid[1::2], ZERO]


def _serpentine(pan_deg: float, tilt_deg: float) -> list[Position]:
    """The grid row by row, to and fro, so that the head's moves stay short."""
    pans = np.linspace(-pan_deg, pan_deg, PAN_POSITIONS)
    tilts = np.linspace(-tilt_deg, tilt_deg, TILT_POSITIONS)
    return [
        (round(float(pan), 4), round(float(tilt), 4))
        for row, tilt in enumerate(tilts)
        for pan in (pans if row % 2 == 0 else pans[::-1])
    ]
