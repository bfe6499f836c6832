"""One frame pair to one measurement: the straight line of the whole system."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from core.calibration.calibrate import Calibration
from core.checkerboard.board import Board
from core.checkerboard.corners import LocatedBoard, detect_board, locate_board
from core.checkerboard.resection import BoardPose, resect
from core.discs.disc_finder import Discs, find_discs
from core.errors import ImageError, ImageSizeError, TargetNotFoundError
from core.images import GreyImage, require_size
from core.quality.verdicts import (
    flag_of,
    is_inconsistent,
    judge_further,
    judge_main,
    judge_motion,
    judge_sub,
    judge_value,
    overexposed,
    too_dark,
)
from core.results import (
    Diagnostics,
    Displacement,
    Flag,
    Measurement,
    Reason,
    RigMotion,
    TargetMeasurement,
)
from core.rig.calibrated_site import CalibratedSite
from core.rig.closure import close, closure_of, consistent, is_beyond, joint_shifts
from core.rig.compensation import (
    CommonShift,
    SeenTarget,
    raw_displacement,
    remaining_shifts,
    rig_motion,
)
from core.rig.learnt import Learnt
from core.rig.stability import Moment, Term, main_scale, stability_terms
from core.rig.target_search import find_calibrated_targets
from core.site import MAIN, CameraGeometry, ExtraTarget, Site

_USED_WEIGHT = 0.5
"""Weight from which a corner is counted as used."""
_FIXED_RESIDUAL_PX = 0.05
"""rms of the discs of a fixed target about their common shift, from which it is not believed. As
in the verdict on targets."""
_OF_ALL_TARGETS = frozenset(
    {
        Reason.MAIN_IMAGE_UNREADABLE,
        Reason.SUB_IMAGE_UNREADABLE,
        Reason.MAIN_IMAGE_WRONG_SIZE,
        Reason.SUB_IMAGE_WRONG_SIZE,
        Reason.MAIN_IMAGE_MISSING,
        Reason.SUB_IMAGE_MISSING,
        Reason.TOO_DARK,
        Reason.SUB_TARGET_NOT_FOUND,
        Reason.SUB_TARGET_PARTLY_HIDDEN,
        Reason.SUB_TARGET_DISTURBED,
        Reason.SUB_TARGET_UNCERTAIN,
        Reason.SUB_TARGET_CHANGED,
        Reason.MOTION_OUT_OF_RANGE,
        Reason.NOT_SIMULTANEOUS,
        Reason.CLOSURE_TOO_LARGE,
    }
)
"""Reasons of a row that concern every target in it."""


def measure_pair(
    main: GreyImage | None,
    sub: GreyImage | None,
    site: Site,
    calibration: Calibration,
    skew_s: float | None = None,
    moment: Moment | None = None,
    distrusted: Collection[str] = (),
    learnt: Learnt | None = None,
) -> Measurement:
    """Measure one pair.

    Discs, board, pose, rig motion (Eq. 12), false shift (Eq. 15, 17), displacement (Eq. 20)
    `d = inv(B~) (u_j - u_false_j)`, what fixed targets show of the rig's error, verdict; Eq. n of
    Lee et al. (2020), see docs/method.md. Never raises for what an image shows; None means there
    is no image. skew_s is the trigger of the sub image less that of the main one. With moment the
    sigmas hold what may have changed since the reference; without, the pixels and the calibration
    alone. Fixed targets named in distrusted are measured and not believed. Where none is
    believed, what was learnt of the rig (with a moment) is taken off. An example is in
    docs/functions.md.
    """
    calibrated = calibration.calibrated
    sub_seen, sub_reasons = _see_sub(sub, site, calibrated)
    motion = None if sub_seen is None else rig_motion(calibrated, sub_seen.pose)
    main_seen, reasons = _see_main(main, site, calibrated, motion)
    reasons += sub_reasons
    if motion is not None:
        reasons += judge_motion(calibrated, motion, site)
    terms = _stability(site, calibration, moment)
    seen_before = _Before(terms, distrusted, learnt, moment)
    together = _together(main_seen, sub_seen, site, calibration, seen_before)
    corrected = together.corrected.get(MAIN)
    raw = main_seen.raw.get(MAIN)
    common = together.common.get(MAIN) or main_seen.common.get(MAIN)
    if corrected is not None:
        reasons += judge_value(corrected, site)
    if common is not None:
        reasons += judge_main(calibrated, main_seen.discs[MAIN], common if sub_seen else None)
    reasons += together.reasons
    if skew_s is not None and abs(skew_s) * 1e3 > site.quality.max_skew_ms:
        reasons.append(Reason.NOT_SIMULTANEOUS)
    unique = tuple(dict.fromkeys(reasons))
    if common is not None and is_inconsistent(common, sub_seen.pose if sub_seen else None):
        raw = corrected = None
    return Measurement(
        flag_of(unique, has_value=corrected is not None),
        unique,
        corrected,
        raw,
        motion,
        _diagnostics(main_seen.discs.get(MAIN), sub_seen, common.residual_px if common else None),
        frames_used=0 if corrected is None else 1,
        closure=together.closure,
        targets=tuple(
            _further(extra, main_seen, sub_seen, together, reasons, calibrated)
            for extra in site.extra_targets
        ),
    )


def look_at_pair(main: GreyImage | None, sub: GreyImage | None, site: Site) -> Measurement:
    """Say what a pair shows of both targets by the config alone, while there is no calibration.

    The measurement has no value, its diagnostics say what was found. Never raises for what an
    image shows; None means there is no image.
    """
    discs, board = None, None
    reasons = [Reason.NO_CALIBRATION]
    image, why = _usable(main, site.main, "main")
    reasons += why
    if image is not None:
        try:
            discs = find_discs(image, site.main_target, site.nominal_px_per_mm)
        except TargetNotFoundError:
            reasons += _not_found(image, Reason.MAIN_TARGET_NOT_FOUND)
    image, why = _usable(sub, site.sub, "sub")
    reasons += why
    if image is not None:
        try:
            board = detect_board(image, Board.nominal(site.sub_target))
        except TargetNotFoundError:
            reasons += _not_found(image, Reason.SUB_TARGET_NOT_FOUND)
    seen = Diagnostics(
        discs_found=0 if discs is None else int(discs.found.sum()),
        corners_used=0 if board is None else len(board.view.index),
        main_contrast_dn=None if discs is None else discs.contrast_dn,
        sub_contrast_dn=None if board is None else board.contrast_dn,
        main_blur_px=None if discs is None else discs.blur_px,
        sub_blur_px=None if board is None else board.blur_px,
    )
    return Measurement(Flag.BAD, tuple(dict.fromkeys(reasons)), None, None, None, seen)


@dataclass(frozen=True, slots=True)
class _MainSeen:
    """What the main image shows, by the targets' names."""

    discs: dict[str, Discs]
    raw: dict[str, Displacement]
    common: dict[str, CommonShift]


@dataclass(frozen=True, slots=True)
class _Before:
    """What is known before the images are looked at."""

    terms: Sequence[Term]
    distrusted: Collection[str]
    learnt: Learnt | None
    moment: Moment | None


@dataclass(frozen=True, slots=True)
class _Together:
    """What both images together say, by the targets' names."""

    corrected: dict[str, Displacement]
    common: dict[str, CommonShift]
    closure: Displacement | None
    moved: frozenset[str]
    """Fixed targets that are not believed."""
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True)
class _SubSeen:
    located: LocatedBoard
    pose: BoardPose


def _usable(
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


def _not_found(image: GreyImage, reason: Reason) -> list[Reason]:
    return [Reason.TOO_DARK, reason] if too_dark(image) else [reason]


def _see_main(
    image: GreyImage | None, site: Site, calibrated: CalibratedSite, motion: RigMotion | None
) -> tuple[_MainSeen, list[Reason]]:
    nothing = _MainSeen({}, {}, {})
    image, reasons = _usable(image, site.main, "main")
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
        reasons += _not_found(image, Reason.MAIN_TARGET_NOT_FOUND)
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
    image, reasons = _usable(image, site.sub, "sub")
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
        return None, reasons + _not_found(image, Reason.SUB_TARGET_NOT_FOUND)
    return _SubSeen(located, pose), reasons + judge_sub(calibrated, located, pose)


def _stability(site: Site, calibration: Calibration, moment: Moment | None) -> tuple[Term, ...]:
    if moment is None or calibration.reference is None:
        return ()
    return stability_terms(
        site, main_scale(calibration.calibrated.B), calibration.reference, moment
    )


def _together(
    main: _MainSeen,
    sub: _SubSeen | None,
    site: Site,
    calibration: Calibration,
    before: _Before,
) -> _Together:
    """Take the rig's motion off all targets, and what the fixed ones show off the rest."""
    calibrated, terms, distrusted = calibration.calibrated, before.terms, before.distrusted
    seen = [
        SeenTarget(target, main.discs[target.name])
        for target in (calibrated.main_target, *calibrated.further)
        if target.name in main.discs
    ]
    if sub is None or not seen:
        return _Together({}, {}, None, frozenset(), ())
    shifts = remaining_shifts(calibrated, seen, sub.pose, sub.located.view)
    joint = joint_shifts(shifts, site, site.main.centre_px, terms)
    common = dict(zip(joint.names, shifts.common, strict=True))
    clean = [
        name
        for name, fixed in zip(joint.names, joint.fixed, strict=True)
        if fixed and name not in distrusted and common[name].residual_px < _FIXED_RESIDUAL_PX
    ]
    believed = consistent(joint, clean)
    moved = frozenset(clean) - set(believed)
    closure = closure_of(joint, believed)
    if before.learnt is not None and before.moment is not None and terms and not believed:
        prior = before.learnt.prior(site, calibrated.B, terms, before.moment)
        joint = joint_shifts(shifts, site, site.main.centre_px, terms, prior)
    reasons = [Reason.FIXED_TARGET_MOVED] if moved else []
    if closure is not None and terms and is_beyond(closure):
        reasons.append(Reason.CLOSURE_TOO_LARGE)
    not_believed = moved | set(distrusted).intersection(joint.names)
    return _Together(close(joint, believed), common, closure, not_believed, tuple(reasons))


def _further(
    extra: ExtraTarget,
    main: _MainSeen,
    sub: _SubSeen | None,
    together: _Together,
    row: Sequence[Reason],
    calibrated: CalibratedSite,
) -> TargetMeasurement:
    """What a pair says of a further target."""
    name = extra.name
    target = next((one for one in calibrated.further if one.name == name), None)
    corrected, raw = together.corrected.get(name), main.raw.get(name)
    reasons: list[Reason] = [reason for reason in row if reason in _OF_ALL_TARGETS]
    if target is None:
        reasons.append(Reason.TARGET_NOT_CALIBRATED)
    elif name not in main.discs:
        reasons.append(Reason.TARGET_NOT_FOUND)
    else:
        common = together.common.get(name)
        reasons += judge_further(target, main.discs[name], common)
        if is_inconsistent(common or main.common[name], sub.pose if sub else None):
            raw = corrected = None
    if name in together.moved:
        reasons.append(Reason.FIXED_TARGET_MOVED)
    unique = tuple(dict.fromkeys(reasons))
    flag = flag_of(unique, has_value=corrected is not None)
    return TargetMeasurement(name, extra.role, flag, unique, corrected, raw)


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
