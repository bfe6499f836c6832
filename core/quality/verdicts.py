"""The verdict on a measurement: a flag, and reasons from the closed list."""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.corners import LocatedBoard
from core.checkerboard.resection import BoardPose
from core.checkerboard.shadow import crossed_by_shadow
from core.discs.disc_finder import Discs
from core.images import GreyImage
from core.quality.print_fingerprint import print_mismatch
from core.quality.residual_ratio import LEAST_RMS_PX, contrast_noise_factor
from core.results import Displacement, Flag, Reason, RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.compensation import AFFINE_LIMIT_PX, CommonShift, affine_error_px
from core.rig.paper import PaperModel
from core.site import Site

_PIXEL_STEP = 4
"""Every fourth row and column does for the light of a whole image."""
_BRIGHT_PERCENTILE = 99.0
"""What counts as the bright parts of an image: the discs are some per cent of the main one."""
_DARK_SHARE = 0.08
"""Of full scale: bright parts below it are too dark (20 DN of 8 bits, a few DN of contrast on top
of the noise). Only says why a target was not found."""
_SATURATED_SHARE = 0.3
"""Of all pixels: so many are saturated only when the white of the target is too."""
_HIDDEN_SHARE = 0.005
"""Of the board's corners: five of 930. Chosen: less does not move a value; insensitive."""
_OUTLIER_WEIGHT = 0.1
"""Weight of a corner that does not fit: it is 5.3 standard deviations off."""
_OUTLIER_PX = 0.05
"""And so far at least: more than a board's print errors leave."""
_MISMATCH_SHARE = 0.25
"""Of the print errors that may be missing: two squares off, even the lines of one direction alone
leave 0.4. Insensitive from 0.12 to 0.5."""
_CLEAN = 0.95
"""Share of a disc's pixels that its model explains, below which something covers a part of it. On
the rendered sets every clear disc has more (measured)."""
_BLUR_FACTOR = 2.0
"""Times the blur at calibration. Chosen: at 1 most rows of the rendered sets are flagged, at 2 none
(measured)."""
_LEAST_MAIN_BLUR_PX, _LEAST_SUB_BLUR_PX = 1.0, 0.8
"""Blur that is never unusual: a sharp lens, its pixels' own squares counted in."""
_RESIDUAL_FACTOR = 3.0
"""Times the residuals at calibration, contrast allowed for. Insensitive from 1.5 to 6."""
_MAIN_RESIDUAL_PX = 0.05
"""rms of the discs about their common shift, the rig's motion taken off: 0.004 mm at 12 px/mm.
Clear discs of the rendered sets leave less than half of it (measured)."""
_NO_VALUE_PX = 1.0
"""Discs or corners that miss by a whole pixel are not the target's."""
_RANGE_FACTOR = 4.0
"""Times the largest motion of calibration or expected drift, about or along one axis: beyond it
corrections are extrapolated. Insensitive from 2 to 8."""
_MISSING = {Reason.MAIN_IMAGE_MISSING, Reason.SUB_IMAGE_MISSING}


def too_dark(image: GreyImage) -> bool:
    """Whether even the bright parts of an image are near black."""
    bright = float(np.percentile(image.pixels[::_PIXEL_STEP, ::_PIXEL_STEP], _BRIGHT_PERCENTILE))
    return bright < _DARK_SHARE * image.saturation_dn


def overexposed(image: GreyImage) -> bool:
    """Whether a large part of an image is saturated."""
    share = float((image.pixels[::_PIXEL_STEP, ::_PIXEL_STEP] >= image.saturation_dn).mean())
    return share > _SATURATED_SHARE


def judge_main(calibrated: CalibratedSite, discs: Discs, shift: CommonShift | None) -> list[Reason]:
    """What is doubtful about the main target; shift is what is left with the rig's motion off.

    None where that is not known: the rig's roll turns the discs about one another, too.
    """
    reasons = []
    wanted = np.isfinite(calibrated.reference_discs_px).all(axis=1)
    if (discs.explained_fraction[wanted] < _CLEAN).any() or not discs.found[wanted].all():
        reasons.append(Reason.MAIN_TARGET_PARTLY_HIDDEN)
    if shift is not None and shift.residual_px > _MAIN_RESIDUAL_PX:
        reasons.append(Reason.MAIN_TARGET_DISTURBED)
    if discs.blur_px > _BLUR_FACTOR * max(calibrated.baseline.main_blur_px, _LEAST_MAIN_BLUR_PX):
        reasons.append(Reason.BLURRED)
    return reasons


def judge_further(
    target: CalibratedTarget, discs: Discs, shift: CommonShift | None
) -> list[Reason]:
    """What is doubtful about a further target in the main image; shift as for the main one."""
    reasons = []
    wanted = np.isfinite(target.reference_px).all(axis=1)
    if (discs.explained_fraction[wanted] < _CLEAN).any() or not discs.found[wanted].all():
        reasons.append(Reason.TARGET_PARTLY_HIDDEN)
    if shift is not None and shift.residual_px > _MAIN_RESIDUAL_PX:
        reasons.append(Reason.TARGET_DISTURBED)
    return reasons


def judge_sub(calibrated: CalibratedSite, located: LocatedBoard, board: BoardPose) -> list[Reason]:
    """What is doubtful about the sub target."""
    reasons = []
    if not located.unambiguous:
        reasons.append(Reason.SUB_TARGET_UNCERTAIN)
    if _hidden(located, board) > _HIDDEN_SHARE * located.visible:
        reasons.append(Reason.SUB_TARGET_PARTLY_HIDDEN)
    baseline = calibrated.baseline
    usual_px = max(baseline.sub_rms_px, LEAST_RMS_PX)
    usual_px *= contrast_noise_factor(baseline.sub_contrast_dn, located.contrast_dn)
    if board.rms_px > _RESIDUAL_FACTOR * usual_px:
        reasons.append(Reason.SUB_TARGET_DISTURBED)
    if _is_another_board(calibrated, located, board):
        reasons.append(Reason.SUB_TARGET_CHANGED)
    if located.blur_px > _BLUR_FACTOR * max(calibrated.baseline.sub_blur_px, _LEAST_SUB_BLUR_PX):
        reasons.append(Reason.BLURRED)
    return reasons


def _hidden(located: LocatedBoard, board: BoardPose) -> int:
    """How many corners something lies on: those lost to a shadow's edge are not among them."""
    off = np.hypot(board.residuals_px[:, 0], board.residuals_px[:, 1])
    outlying = (board.weights < _OUTLIER_WEIGHT) & (off > _OUTLIER_PX)
    points = located.view.points_px
    lost = np.concatenate([located.missing_px, points[outlying]])
    white, black = located.white_dn[~outlying], located.black_dn[~outlying]
    crossed = crossed_by_shadow(lost, points[~outlying], white, black)
    return int((~crossed).sum())


def _is_another_board(calibrated: CalibratedSite, located: LocatedBoard, board: BoardPose) -> bool:
    """Whether the print errors of the calibrated board are missing.

    Print errors smaller than the noise of a corner are known too poorly to be missed, and too
    small to spoil a value.
    """
    share, size_px = print_mismatch(calibrated, located.view, board)
    return share > _MISMATCH_SHARE and size_px > calibrated.baseline.sub_rms_px


def is_inconsistent(shift: CommonShift, board: BoardPose | None) -> bool:
    """Whether the discs or the corners contradict each other so far that no value can be given."""
    if shift.residual_px > _NO_VALUE_PX:
        return True
    return board is not None and board.median_rms_px > _NO_VALUE_PX


def judge_motion(calibrated: CalibratedSite, motion: RigMotion, site: Site) -> list[Reason]:
    """Whether the rig moved further than the calibration and the expected drift cover.

    Axis by axis, as the drift is expected: a motion along all three is longer than along one.
    """
    turn = max(calibrated.baseline.max_rotation_rad, site.quality.expected_drift_mrad * 1e-3)
    slide = max(calibrated.baseline.max_translation_mm, site.quality.expected_drift_mm)
    far = float(np.abs(motion.rotation_rad).max()) > _RANGE_FACTOR * turn
    far |= float(np.abs(motion.translation_mm).max()) > _RANGE_FACTOR * slide
    reasons = [Reason.MOTION_OUT_OF_RANGE] if far else []
    if isinstance(calibrated.model, PaperModel):
        off_axis = float(np.nanmax(np.abs(calibrated.reference_discs_px - site.main.centre_px)))
        distance, axial = site.main_target.distance_mm, float(motion.translation_mm[2])
        if affine_error_px(distance, axial, off_axis) > AFFINE_LIMIT_PX:
            reasons.append(Reason.AFFINE_INVALID)
    return reasons


def judge_value(corrected: Displacement, site: Site) -> list[Reason]:
    """Whether the value is too uncertain by its pixels and the calibration."""
    sigma: FloatArray = np.sqrt(np.diag(corrected.by_image_mm2))
    return [Reason.SIGMA_TOO_LARGE] if float(sigma.max()) > site.quality.max_sigma_mm else []


def flag_of(reasons: tuple[Reason, ...], *, has_value: bool) -> Flag:
    """Good without a reason, suspect with a value, missing or bad without one.

    >>> flag_of((Reason.BLURRED,), has_value=True)
    <Flag.SUSPECT: 3>
    """
    if has_value:
        return Flag.SUSPECT if reasons else Flag.GOOD
    return Flag.MISSING if _MISSING.intersection(reasons) else Flag.BAD
