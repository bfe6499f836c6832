"""Values that are allowed one by one but cannot all be true of a real site: most often a unit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from core.site import CameraGeometry, CheckerboardTarget, CirclesTarget, RigPrior, Site

_MIN_DISC_PX = 3.0
_MIN_SQUARE_PX = 4.0
_MIN_OFFSET_MM = 5.0
"""No two cameras have their centres of projection so near to one another."""


def implausible_values(site: Site) -> list[str]:
    """Name keys whose values do not fit the others, each with the likely mistake."""
    swapped = _focal_lengths(site)
    if swapped is not None:
        return [swapped]
    problems: tuple[str | None, ...] = (
        _distance("main", site.main, site.main_target.distance_mm),
        _distance("sub", site.sub, site.sub_target.distance_mm),
        _radians(site.rig),
        _offset(site.rig),
    )
    if not any(problems):
        # Image sizes say nothing as long as the distance itself is wrong.
        problems = (
            _distance_sigma(site.main_target),
            _layout(site.main_target),
            _disc_size(site.main, site.main_target),
            _square_size(site.sub, site.sub_target),
            *_extra_targets(site),
        )
    return [problem for problem in problems if problem]


def _extra_targets(site: Site) -> list[str | None]:
    problems = []
    for number, extra in enumerate(site.extra_targets):
        target = extra.target
        problem = (
            _distance("main", site.main, target.distance_mm)
            or _distance_sigma(target)
            or _layout(target)
            or _disc_size(site.main, target)
        )
        key = f"target.extra[{number}]"
        problems.append(problem and problem.replace("target.main", key, 1))
        if extra.position_px is not None and not _inside(site.main, extra.position_px.tolist()):
            problems.append(
                f"{key}.position_px: {extra.position_px.tolist()} is outside the image of "
                f"{site.main.width_px} x {site.main.height_px} px; is it x, y from the top left?"
            )
    return problems


def _inside(camera: CameraGeometry, position_px: list[float]) -> bool:
    x, y = position_px
    return 0 <= x < camera.width_px and 0 <= y < camera.height_px


def _focal_lengths(site: Site) -> str | None:
    """Whether the focal lengths fit the distances and targets only once they are exchanged."""
    main_mm, sub_mm = site.main.focal_length_mm, site.sub.focal_length_mm

    def fit(main: CameraGeometry, sub: CameraGeometry) -> bool:
        return not any(
            (
                _distance("main", main, site.main_target.distance_mm),
                _distance("sub", sub, site.sub_target.distance_mm),
                _disc_size(main, site.main_target),
                _square_size(sub, site.sub_target),
            )
        )

    exchanged = (
        replace(site.main, focal_length_mm=sub_mm),
        replace(site.sub, focal_length_mm=main_mm),
    )
    if main_mm >= sub_mm or fit(site.main, site.sub) or not fit(*exchanged):
        return None
    return (
        f"camera.main.focal_length_mm: {main_mm:g} mm and camera.sub.focal_length_mm: {sub_mm:g} "
        "mm fit the targets only the other way round; exchange them"
    )


def _distance(which: str, camera: CameraGeometry, distance_mm: float) -> str | None:
    """A lens makes an image only of what is further away than its focal length."""
    if distance_mm > camera.focal_length_mm:
        return None
    return (
        f"target.{which}.distance_mm: {distance_mm:g} mm is nearer than the focal length of "
        f"{camera.focal_length_mm:g} mm; is this in metres?"
    )


def _distance_sigma(target: CirclesTarget) -> str | None:
    if target.distance_sigma_mm <= target.distance_mm:
        return None
    return (
        f"target.main.distance_sigma_mm: {target.distance_sigma_mm:g} mm is more than distance_mm "
        f"{target.distance_mm:g}; is this in micrometres?"
    )


def _offset(rig: RigPrior) -> str | None:
    apart_mm = float(np.linalg.norm(rig.offset_main_sub_mm))
    if apart_mm >= _MIN_OFFSET_MM:
        return None
    return (
        f"rig.offset_main_sub_mm: the cameras would be {apart_mm:.2g} mm apart, one inside the "
        "other; is this in metres?"
    )


def _radians(rig: RigPrior) -> str | None:
    turns = np.abs(rig.rotation_main_sub_deg)
    near = np.isclose(turns, math.pi, atol=2e-3) | np.isclose(turns, math.pi / 2, atol=2e-3)
    if not near.any():
        return None
    values = rig.rotation_main_sub_deg.tolist()
    return f"rig.rotation_main_sub_deg: {values} looks like radians; write degrees"


def _layout(target: CirclesTarget) -> str | None:
    centres, radii = target.centres_mm, target.diameters_mm / 2
    gaps = np.linalg.norm(centres[:, None] - centres[None, :], axis=2)
    overlaps = np.argwhere(np.triu(gaps < radii[:, None] + radii[None, :], 1))
    if len(overlaps):
        first, second = overlaps[0] + 1
        return (
            f"target.main.centres_mm: discs {first} and {second} overlap with the given "
            "diameter_mm; are both in mm?"
        )
    if np.linalg.matrix_rank(centres - centres.mean(axis=0), tol=1e-6) < 2:
        return "target.main.centres_mm: all discs lie on one line; at least one must be off it"
    return None


def _disc_size(camera: CameraGeometry, target: CirclesTarget) -> str | None:
    px_per_mm = camera.focal_px / target.distance_mm
    smallest_px = float(target.diameters_mm.min()) * px_per_mm
    extent_px = float(np.ptp(target.centres_mm, axis=0).max()) * px_per_mm
    image_px = max(camera.width_px, camera.height_px)
    if smallest_px < _MIN_DISC_PX:
        problem = f"diameter_mm: the smallest disc would be {smallest_px:.2g} px across"
    elif extent_px > image_px:
        problem = (
            f"centres_mm: the target would be {extent_px:.0f} px wide in an image of {image_px} px"
        )
    else:
        return None
    return f"target.main.{problem} ({_optics(camera, target.distance_mm)}); is every unit right?"


def _square_size(camera: CameraGeometry, target: CheckerboardTarget) -> str | None:
    square_px = target.square_mm * camera.focal_px / target.distance_mm
    # At least four squares must be in view, or the pose has nothing to hold on to.
    largest_px = min(camera.width_px, camera.height_px) / 4
    if _MIN_SQUARE_PX <= square_px <= largest_px:
        return None
    return (
        f"target.sub.square_mm: a square would be {square_px:.2g} px wide, usable are "
        f"{_MIN_SQUARE_PX:g} to {largest_px:.0f} px ({_optics(camera, target.distance_mm)}); "
        "is every unit right?"
    )


def _optics(camera: CameraGeometry, distance_mm: float) -> str:
    return (
        f"focal_length_mm {camera.focal_length_mm:g}, pixel_pitch_um {camera.pixel_pitch_um:g}, "
        f"distance_mm {distance_mm:g}"
    )
