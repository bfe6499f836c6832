"""Values that are allowed one by one but cannot all be true of a real site: most often a unit."""

from __future__ import annotations

import math

import numpy as np

from core.site import CameraGeometry, CheckerboardTarget, CirclesTarget, RigPrior, Site

_MIN_DISC_PX = 3.0
_MIN_SQUARE_PX = 4.0


def implausible_values(site: Site) -> list[str]:
    """Name keys whose values do not fit the others, each with the likely mistake."""
    problems = [
        *_distance("main", site.main, site.main_target.distance_mm),
        *_distance("sub", site.sub, site.sub_target.distance_mm),
        *_radians(site.rig),
    ]
    # Image sizes say nothing as long as the distance itself is wrong.
    return problems or [
        *_circles(site.main, site.main_target),
        *_board(site.sub, site.sub_target),
    ]


def _distance(which: str, camera: CameraGeometry, distance_mm: float) -> list[str]:
    """A lens makes an image only of what is further away than its focal length."""
    if distance_mm > camera.focal_length_mm:
        return []
    return [
        f"target.{which}.distance_mm: {distance_mm:g} mm is nearer than the focal length of "
        f"{camera.focal_length_mm:g} mm; is this in metres?"
    ]


def _radians(rig: RigPrior) -> list[str]:
    turns = np.abs(rig.rotation_main_sub_deg)
    near = np.isclose(turns, math.pi, atol=2e-3) | np.isclose(turns, math.pi / 2, atol=2e-3)
    if not near.any():
        return []
    values = rig.rotation_main_sub_deg.tolist()
    return [f"rig.rotation_main_sub_deg: {values} looks like radians; write degrees"]


def _circles(camera: CameraGeometry, target: CirclesTarget) -> list[str]:
    centres, diameters = target.centres_mm, target.diameters_mm
    px_per_mm = camera.focal_px / target.distance_mm
    seen = (
        f"(focal_length_mm {camera.focal_length_mm:g}, pixel_pitch_um {camera.pixel_pitch_um:g}, "
        f"distance_mm {target.distance_mm:g})"
    )
    extent_px = float(np.ptp(centres, axis=0).max()) * px_per_mm
    image_px = max(camera.width_px, camera.height_px)
    gaps = np.linalg.norm(centres[:, None] - centres[None, :], axis=2)
    touching = gaps < (diameters[:, None] + diameters[None, :]) / 2
    first, second = (np.argwhere(np.triu(touching, 1)).tolist() or [(None, None)])[0]
    if first is not None:
        return [
            f"target.main.centres_mm: discs {first + 1} and {second + 1} overlap with the given "
            "diameter_mm; are both in mm?"
        ]
    if np.linalg.matrix_rank(centres - centres.mean(axis=0), tol=1e-6) < 2:
        return ["target.main.centres_mm: all discs lie on one line; at least one must be off it"]
    if diameters.min() * px_per_mm < _MIN_DISC_PX:
        return [
            f"target.main.diameter_mm: a disc of {diameters.min():g} mm would be "
            f"{diameters.min() * px_per_mm:.2g} px across {seen}; is every unit right?"
        ]
    if extent_px > image_px:
        return [
            f"target.main.centres_mm: the target would be {extent_px:.0f} px wide in an image of "
            f"{image_px} px {seen}; is every unit right?"
        ]
    return []


def _board(camera: CameraGeometry, target: CheckerboardTarget) -> list[str]:
    square_px = target.square_mm * camera.focal_px / target.distance_mm
    # At least four squares must be in view, or the pose has nothing to hold on to.
    largest_px = min(camera.width_px, camera.height_px) / 4
    if _MIN_SQUARE_PX <= square_px <= largest_px:
        return []
    return [
        f"target.sub.square_mm: a square of {target.square_mm:g} mm would be {square_px:.2g} px "
        f"wide (focal_length_mm {camera.focal_length_mm:g}, pixel_pitch_um "
        f"{camera.pixel_pitch_um:g}, distance_mm {target.distance_mm:g}), usable are "
        f"{_MIN_SQUARE_PX:g} to {largest_px:.0f} px; is every unit right?"
    ]
