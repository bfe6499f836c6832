"""One frame pair to one measurement: the straight line of the whole system."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from core.arrays import FloatArray
from core.calibration.calibrate import Calibration
from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.moment import Moment
from core.quality.verdicts import flag_of, judge_value
from core.recognition import find_targets
from core.results import Diagnostics, Displacement, Flag, Measurement, Reason, TargetMeasurement
from core.rig.closure import close, closure_of, consistent, gains_of, is_beyond, joint_shifts
from core.rig.compensation import Shifts
from core.rig.learnt import Learnt
from core.rig.stability import Term, main_scale, stability_terms
from core.seeing import SeenFurther, SeenPair, not_found, see_pair, usable_image
from core.site import MAIN, ExtraTarget, Site, TargetRole

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
    seen = see_pair(main, sub, site, calibration.calibrated)
    return assess_pair(seen, site, calibration, skew_s, moment, distrusted, learnt)


def assess_pair(
    seen: SeenPair,
    site: Site,
    calibration: Calibration,
    skew_s: float | None = None,
    moment: Moment | None = None,
    distrusted: Collection[str] = (),
    learnt: Learnt | None = None,
) -> Measurement:
    """Give the measurement of a pair that was looked at: the rest of `measure_pair`."""
    before = _Before(_stability(site, calibration, moment), distrusted, learnt, moment)
    together = _together(seen.shifts, site, calibration, before)
    corrected, raw = together.corrected.get(MAIN), seen.raw
    reasons = list(seen.reasons)
    if corrected is not None:
        reasons += judge_value(corrected, site)
    reasons += (*seen.main_reasons, *together.reasons)
    if skew_s is not None and abs(skew_s) * 1e3 > site.quality.max_skew_ms:
        reasons.append(Reason.NOT_SIMULTANEOUS)
    unique = tuple(dict.fromkeys(reasons))
    if seen.inconsistent:
        raw = corrected = None
    return Measurement(
        flag_of(unique, has_value=corrected is not None),
        unique,
        corrected,
        raw,
        seen.motion,
        seen.diagnostics,
        frames_used=0 if corrected is None else 1,
        closure=together.closure,
        targets=tuple(
            _further(extra, seen.further[extra.name], together, reasons)
            for extra in site.extra_targets
        ),
    )


def look_at_pair(main: GreyImage | None, sub: GreyImage | None, site: Site) -> Measurement:
    """Say what a pair shows of both targets by the config alone, while there is no calibration.

    The measurement has no value, its diagnostics say what was found of the main target, which is
    told from further ones, and of the board. Never raises for what an
    image shows; None means there is no image.
    """
    discs, board = None, None
    reasons = [Reason.NO_CALIBRATION]
    image, why = usable_image(main, site.main, "main")
    reasons += why
    if image is not None:
        try:
            discs = find_targets(image, site)[0]
        except TargetNotFoundError:
            discs = None
        if discs is None:
            reasons += not_found(image, Reason.MAIN_TARGET_NOT_FOUND)
    image, why = usable_image(sub, site.sub, "sub")
    reasons += why
    if image is not None:
        try:
            board = detect_board(image, Board.nominal(site.sub_target))
        except TargetNotFoundError:
            reasons += not_found(image, Reason.SUB_TARGET_NOT_FOUND)
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
class _Before:
    """What is known beside the images."""

    terms: Sequence[Term]
    distrusted: Collection[str]
    learnt: Learnt | None
    moment: Moment | None


@dataclass(frozen=True, slots=True)
class _Together:
    """What all targets together say, by their names."""

    corrected: dict[str, Displacement]
    closure: Displacement | None
    moved: frozenset[str]
    """Fixed targets that are not believed."""
    reasons: tuple[Reason, ...]
    taken_off: dict[str, dict[str, FloatArray]]
    """By the fixed target, and by the target that its error is taken off."""


def _stability(site: Site, calibration: Calibration, moment: Moment | None) -> tuple[Term, ...]:
    if moment is None or calibration.reference is None:
        return ()
    calibrated = calibration.calibrated
    return stability_terms(
        site, main_scale(calibrated.B), calibration.reference, moment, calibrated.lens
    )


def _together(
    shifts: Shifts | None, site: Site, calibration: Calibration, before: _Before
) -> _Together:
    """Take what the fixed targets show off the others."""
    calibrated, terms, distrusted = calibration.calibrated, before.terms, before.distrusted
    if shifts is None:
        return _Together({}, None, frozenset(), (), {})
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
    gains = {name: gains_of(joint, believed, name) for name in joint.names}
    taken_off = {
        fixed: {name: gain[fixed] for name, gain in gains.items() if fixed in gain}
        for fixed in believed
    }
    return _Together(close(joint, believed), closure, not_believed, tuple(reasons), taken_off)


def _further(
    extra: ExtraTarget, seen: SeenFurther, together: _Together, row: Sequence[Reason]
) -> TargetMeasurement:
    """What a pair says of a further target."""
    corrected, raw = together.corrected.get(extra.name), seen.raw
    reasons = [reason for reason in row if reason in _OF_ALL_TARGETS]
    reasons += seen.reasons
    if seen.inconsistent:
        raw = corrected = None
    if extra.name in together.moved:
        reasons.append(Reason.FIXED_TARGET_MOVED)
    unique = tuple(dict.fromkeys(reasons))
    flag = flag_of(unique, has_value=corrected is not None)
    taken_off = together.taken_off.get(extra.name, {}) if extra.role is TargetRole.FIXED else None
    return TargetMeasurement(extra.name, extra.role, flag, unique, corrected, raw, taken_off)
