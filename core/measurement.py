"""One frame pair to one measurement: the straight line of the whole system."""

from __future__ import annotations

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
    judge_main,
    judge_motion,
    judge_sub,
    judge_value,
    overexposed,
    too_dark,
)
from core.results import Diagnostics, Displacement, Flag, Measurement, Reason
from core.rig.calibrated_site import CalibratedSite
from core.rig.compensation import CommonShift, corrected_displacement, raw_displacement, rig_motion
from core.site import CameraGeometry, Site

_USED_WEIGHT = 0.5
"""Weight from which a corner is counted as used."""


def measure_pair(
    main: GreyImage | None,
    sub: GreyImage | None,
    site: Site,
    calibration: Calibration,
    skew_s: float | None = None,
) -> Measurement:
    """Measure one pair.

    Discs, board, pose, rig motion (Eq. 12), false shift (Eq. 15, 17), displacement (Eq. 20)
    `d = inv(B~) (u_j - u_false_j)`, verdict; Eq. n of Lee et al. (2020), see docs/method.md. Never
    raises for what an image shows; None means there is no image. skew_s is the trigger of the sub
    image less that of the main one. An example is in docs/functions.md.
    """
    calibrated = calibration.calibrated
    main_seen, reasons = _see_main(main, site, calibrated)
    sub_seen, sub_reasons = _see_sub(sub, site, calibrated)
    reasons += sub_reasons
    raw = corrected = motion = None
    common = None
    if main_seen is not None:
        raw, common = main_seen.raw, main_seen.shift
    if sub_seen is not None:
        motion = rig_motion(calibrated, sub_seen.pose)
        reasons += judge_motion(calibrated, motion, site)
    if main_seen is not None and sub_seen is not None:
        corrected, common = corrected_displacement(
            calibrated, main_seen.discs, sub_seen.pose, sub_seen.located.view
        )
        reasons += judge_value(corrected, site)
    if main_seen is not None and common is not None:
        reasons += judge_main(calibrated, main_seen.discs, common if sub_seen else None)
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
        _diagnostics(main_seen, sub_seen, common.residual_px if common else None),
        frames_used=0 if corrected is None else 1,
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
    discs: Discs
    raw: Displacement
    shift: CommonShift


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
    image: GreyImage | None, site: Site, calibrated: CalibratedSite
) -> tuple[_MainSeen | None, list[Reason]]:
    image, reasons = _usable(image, site.main, "main")
    if image is None:
        return None, reasons
    try:
        discs = find_discs(
            image, site.main_target, site.nominal_px_per_mm, calibrated.reference_discs_px
        )
        raw, shift = raw_displacement(calibrated, discs)
    except TargetNotFoundError:
        return None, reasons + _not_found(image, Reason.MAIN_TARGET_NOT_FOUND)
    return _MainSeen(discs, raw, shift), reasons


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


def _diagnostics(
    main: _MainSeen | None, sub: _SubSeen | None, residual_px: float | None
) -> Diagnostics:
    return Diagnostics(
        discs_found=0 if main is None else int(main.discs.found.sum()),
        corners_used=0 if sub is None else int((sub.pose.weights > _USED_WEIGHT).sum()),
        main_residual_px=residual_px,
        sub_residual_px=None if sub is None else sub.pose.rms_px,
        main_contrast_dn=None if main is None else main.discs.contrast_dn,
        sub_contrast_dn=None if sub is None else sub.located.contrast_dn,
        main_blur_px=None if main is None else main.discs.blur_px,
        sub_blur_px=None if sub is None else sub.located.blur_px,
    )
