"""Values that are allowed one by one but cannot all be true of a real site: most often a unit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from core.errors import digits
from core.site import CameraGeometry, CheckerboardTarget, CirclesTarget, RigPrior, Site

_MIN_DISC_PX = 3.0
_MIN_SQUARE_PX = 4.0
_MIN_OFFSET_MM = 5.0
"""No two cameras have their centres of projection so near to one another."""


def implausible_values(site: Site) -> list[str]:
    """Name keys whose values do not fit the others, each with the likely mistake."""
    swapped = _exchanged(site)
    if swapped is not None:
        return [swapped]
    problems: tuple[str | None, ...] = (
        _distance("main", site.main, site.main_target),
        _distance("sub", site.sub, site.sub_target),
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
            _distance("main", site.main, target)
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


def _exchanged(site: Site) -> str | None:
    """Whether focal lengths or distances fit one another only once they are exchanged."""

    def fit(site: Site) -> bool:
        return not any(
            (
                _distance("main", site.main, site.main_target),
                _distance("sub", site.sub, site.sub_target),
                _size(site.main, site.main_target),
                _size(site.sub, site.sub_target),
            )
        )

    if fit(site):
        return None
    main, sub, discs, board = site.main, site.sub, site.main_target, site.sub_target
    lenses = replace(
        site,
        main=replace(main, focal_length_mm=sub.focal_length_mm),
        sub=replace(sub, focal_length_mm=main.focal_length_mm),
    )
    if main.focal_length_mm < sub.focal_length_mm and fit(lenses):
        return (
            f"camera.main.focal_length_mm: {main.focal_length_mm:g} mm and "
            f"camera.sub.focal_length_mm: {sub.focal_length_mm:g} mm fit the targets only the "
            "other way round; exchange them"
        )
    places = replace(
        site,
        main_target=replace(discs, distance_mm=board.distance_mm),
        sub_target=replace(board, distance_mm=discs.distance_mm),
    )
    if discs.distance_mm < board.distance_mm and fit(places):
        return (
            f"target.main.distance_mm: {discs.distance_mm:g} mm and target.sub.distance_mm: "
            f"{board.distance_mm:g} mm fit the lenses only the other way round; exchange them"
        )
    return None


def _distance(
    which: str, camera: CameraGeometry, target: CirclesTarget | CheckerboardTarget
) -> str | None:
    """A lens makes an image only of what is further away than its focal length."""
    distance_mm, focal_mm = target.distance_mm, camera.focal_length_mm
    if distance_mm > focal_mm:
        return None
    in_metres = replace(target, distance_mm=1000.0 * distance_mm)
    likely = in_metres.distance_mm > focal_mm and _size(camera, in_metres) is None
    cure = "is this in metres?" if likely else f"correct it, or camera.{which}.focal_length_mm"
    return (
        f"target.{which}.distance_mm: {distance_mm:g} mm is nearer than the focal length of "
        f"{focal_mm:g} mm; {cure}"
    )


def _size(camera: CameraGeometry, target: CirclesTarget | CheckerboardTarget) -> str | None:
    if isinstance(target, CirclesTarget):
        return _disc_size(camera, target)
    return _square_size(camera, target)


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
        problem = f"diameter_mm: the smallest disc would be {digits(smallest_px)} px across"
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
        f"target.sub.square_mm: a square would be {digits(square_px)} px wide, usable are "
        f"{_MIN_SQUARE_PX:g} to {largest_px:.0f} px ({_optics(camera, target.distance_mm)}); "
        "is every unit right?"
    )


def _optics(camera: CameraGeometry, distance_mm: float) -> str:
    return (
        f"focal_length_mm {camera.focal_length_mm:g}, pixel_pitch_um {camera.pixel_pitch_um:g}, "
        f"distance_mm {distance_mm:g}"
    )
