"""What the images of one pair show, by themselves: all of a measurement that costs time.

Nothing here depends on the rows before, on the time or on what was learnt: pairs can be looked at
in any order, on any computer, and be assessed in order afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from core.checkerboard.corners import LocatedBoard, locate_board
from core.checkerboard.resection import BoardPose, resect
from core.discs.disc_finder import Discs, find_discs
from core.errors import ImageError, ImageSizeError, TargetNotFoundError
from core.images import GreyImage, require_size
from core.quality.verdicts import (
    is_inconsistent,
    judge_further,
    judge_main,
    judge_motion,
    judge_sub,
    overexposed,
    too_dark,
)
from core.results import Diagnostics, Displacement, Reason, RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.compensation import (
    CommonShift,
    SeenTarget,
    Shifts,
    raw_displacement,
    remaining_shifts,
    rig_motion,
)
from core.rig.target_search import find_calibrated_targets
from core.site import MAIN, CameraGeometry, ExtraTarget, Site

_USED_WEIGHT = 0.5
"""Weight from which a corner is counted as used."""


@dataclass(frozen=True, slots=True)
class SeenFurther:
    """What a pair shows of a further target."""

    raw: Displacement | None
    reasons: tuple[Reason, ...]
    inconsistent: bool
    """Its discs contradict each other so far that no value can be given."""


@dataclass(frozen=True, slots=True)
class SeenPair:
    """What a pair shows, without its pixels."""

    reasons: tuple[Reason, ...]
    """Of images, board and rig motion."""
    main_reasons: tuple[Reason, ...]
    """Of the main target."""
    motion: RigMotion | None
    raw: Displacement | None
    inconsistent: bool
    """Discs or corners contradict each other so far that no value can be given."""
    shifts: Shifts | None
    """Of all targets seen, the rig's motion taken off; None without a board or a target."""
    diagnostics: Diagnostics
    further: Mapping[str, SeenFurther]
    """Each further target of the site, by name."""


@dataclass(frozen=True, slots=True)
class _MainSeen:
    """What the main image shows, by the targets' names."""

    discs: dict[str, Discs]
    raw: dict[str, Displacement]
    common: dict[str, CommonShift]


@dataclass(frozen=True, slots=True)
class _SubSeen:
    located: LocatedBoard
    pose: BoardPose


def see_pair(
    main: GreyImage | None, sub: GreyImage | None, site: Site, calibrated: CalibratedSite
) -> SeenPair:
    """Find the targets in a pair, and how far they are from where the rig's motion puts them.

    Never raises for what an image shows; None means there is no image.
    """
    sub_seen, sub_reasons = _see_sub(sub, site, calibrated)
    motion = None if sub_seen is None else rig_motion(calibrated, sub_seen.pose)
    main_seen, reasons = _see_main(main, site, calibrated, motion)
    reasons += sub_reasons
    if motion is not None:
        reasons += judge_motion(calibrated, motion, site)
    shifts = _shifts(main_seen, sub_seen, calibrated)
    clear = {} if shifts is None else _common_of(shifts)
    common = clear.get(MAIN) or main_seen.common.get(MAIN)
    main_reasons: list[Reason] = []
    if common is not None:
        main_reasons = judge_main(calibrated, main_seen.discs[MAIN], common if sub_seen else None)
    pose = sub_seen.pose if sub_seen else None
    return SeenPair(
        tuple(reasons),
        tuple(main_reasons),
        motion,
        main_seen.raw.get(MAIN),
        common is not None and is_inconsistent(common, pose),
        shifts,
        _diagnostics(main_seen.discs.get(MAIN), sub_seen, common.residual_px if common else None),
        {
            extra.name: _see_further(extra, main_seen, sub_seen, clear, calibrated)
            for extra in site.extra_targets
        },
    )


def usable_image(
    image: GreyImage | None, camera: CameraGeometry, role: Literal["main", "sub"]
) -> tuple[GreyImage | None, list[Reason]]:
    """Give an image that can be searched, else None, and what is to be said of it already."""
    if image is None:
        return None, [Reason(f"{role}_image_missing")]
    try:
        require_size(image, camera, f"{role} image")
    except ImageSizeError:
        return None, [Reason(f"{role}_image_wrong_size")]
    except ImageError:
        return None, [Reason(f"{role}_image_unreadable")]
    return image, [Reason.OVEREXPOSED] if overexposed(image) else []


def not_found(image: GreyImage, reason: Reason) -> list[Reason]:
    """Why a target was not found in an image."""
    return [Reason.TOO_DARK, reason] if too_dark(image) else [reason]


def _see_main(
    image: GreyImage | None, site: Site, calibrated: CalibratedSite, motion: RigMotion | None
) -> tuple[_MainSeen, list[Reason]]:
    nothing = _MainSeen({}, {}, {})
    image, reasons = usable_image(image, site.main, "main")
    if image is None:
        return nothing, reasons
    discs = _find_targets(image, site, calibrated, motion)
    raw, common = {}, {}
    for target in (calibrated.main_target, *calibrated.further):
        if target.name not in discs:
            continue
        try:
            found = raw_displacement(calibrated, SeenTarget(target, discs[target.name]))
        except TargetNotFoundError:
            del discs[target.name]
            continue
        raw[target.name], common[target.name] = found
    if MAIN not in discs:
        reasons += not_found(image, Reason.MAIN_TARGET_NOT_FOUND)
    return _MainSeen(discs, raw, common), reasons


def _find_targets(
    image: GreyImage, site: Site, calibrated: CalibratedSite, motion: RigMotion | None
) -> dict[str, Discs]:
    """The discs of all targets that are seen, by name."""
    try:
        if not calibrated.further:
            return {
                MAIN: find_discs(
                    image,
                    site.main_target,
                    site.nominal_px_per_mm,
                    calibrated.reference_discs_px,
                )
            }
        return find_calibrated_targets(image, site, calibrated, motion)
    except TargetNotFoundError:
        return {}


def _see_sub(
    image: GreyImage | None, site: Site, calibrated: CalibratedSite
) -> tuple[_SubSeen | None, list[Reason]]:
    image, reasons = usable_image(image, site.sub, "sub")
    if image is None:
        return None, reasons
    try:
        located = locate_board(
            image,
            calibrated.lens,
            calibrated.board,
            calibrated.corners_mm,
            calibrated.reference_pose,
        )
        pose = resect(calibrated.lens, calibrated.corners_mm, located.view, located.near)
    except TargetNotFoundError:
        return None, reasons + not_found(image, Reason.SUB_TARGET_NOT_FOUND)
    return _SubSeen(located, pose), reasons + judge_sub(calibrated, located, pose)


def _shifts(main: _MainSeen, sub: _SubSeen | None, calibrated: CalibratedSite) -> Shifts | None:
    seen = [
        SeenTarget(target, main.discs[target.name])
        for target in (calibrated.main_target, *calibrated.further)
        if target.name in main.discs
    ]
    if sub is None or not seen:
        return None
    return remaining_shifts(calibrated, seen, sub.pose, sub.located.view)


def _common_of(shifts: Shifts) -> dict[str, CommonShift]:
    names = (target.name for target in shifts.targets)
    return dict(zip(names, shifts.common, strict=True))


def _see_further(
    extra: ExtraTarget,
    main: _MainSeen,
    sub: _SubSeen | None,
    clear: Mapping[str, CommonShift],
    calibrated: CalibratedSite,
) -> SeenFurther:
    name = extra.name
    raw = main.raw.get(name)
    target = next((one for one in calibrated.further if one.name == name), None)
    if target is None:
        return SeenFurther(raw, (Reason.TARGET_NOT_CALIBRATED,), inconsistent=False)
    if name not in main.discs:
        return SeenFurther(raw, (Reason.TARGET_NOT_FOUND,), inconsistent=False)
    common = clear.get(name)
    reasons = judge_further(target, main.discs[name], common)
    inconsistent = is_inconsistent(common or main.common[name], sub.pose if sub else None)
    return SeenFurther(raw, tuple(reasons), inconsistent)


def _diagnostics(
    discs: Discs | None, sub: _SubSeen | None, residual_px: float | None
) -> Diagnostics:
    return Diagnostics(
        discs_found=0 if discs is None else int(discs.found.sum()),
        corners_used=0 if sub is None else int((sub.pose.weights > _USED_WEIGHT).sum()),
        main_residual_px=residual_px,
        sub_residual_px=None if sub is None else sub.pose.rms_px,
        main_contrast_dn=None if discs is None else discs.contrast_dn,
        sub_contrast_dn=None if sub is None else sub.located.contrast_dn,
        main_blur_px=None if discs is None else discs.blur_px,
        sub_blur_px=None if sub is None else sub.located.blur_px,
    )
