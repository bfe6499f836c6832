"""The typed values that leave the core: flags, reasons, a measurement, a calibration's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Any

from core.arrays import FloatArray
from core.site import TargetRole


class Flag(IntEnum):
    """QARTOD flags: good, suspect (value given, reason named), bad (withheld), missing."""

    GOOD = 1
    SUSPECT = 3
    BAD = 4
    MISSING = 9


class Reason(StrEnum):
    """Why a row is not good: a closed list."""

    MAIN_IMAGE_UNREADABLE = "main_image_unreadable"
    SUB_IMAGE_UNREADABLE = "sub_image_unreadable"
    MAIN_IMAGE_WRONG_SIZE = "main_image_wrong_size"
    SUB_IMAGE_WRONG_SIZE = "sub_image_wrong_size"
    MAIN_IMAGE_MISSING = "main_image_missing"
    SUB_IMAGE_MISSING = "sub_image_missing"
    TOO_DARK = "too_dark"
    OVEREXPOSED = "overexposed"
    MAIN_TARGET_NOT_FOUND = "main_target_not_found"
    MAIN_TARGET_PARTLY_HIDDEN = "main_target_partly_hidden"
    MAIN_TARGET_DISTURBED = "main_target_disturbed"
    SUB_TARGET_NOT_FOUND = "sub_target_not_found"
    SUB_TARGET_PARTLY_HIDDEN = "sub_target_partly_hidden"
    SUB_TARGET_DISTURBED = "sub_target_disturbed"
    SUB_TARGET_UNCERTAIN = "sub_target_uncertain"
    SUB_TARGET_CHANGED = "sub_target_changed"
    """Not the board that was calibrated, or its corners are named a period off."""
    BOARD_SLIPPED = "board_slipped"
    """The rig is said to have moved, and the main image did not move with it."""
    CAMERA_BUMPED = "camera_bumped"
    """The target moved faster than the bridge can."""
    CALIBRATION_DRIFTING = "calibration_drifting"
    """For many rows the corners have fitted far worse than at calibration."""
    BLURRED = "blurred"
    MOTION_OUT_OF_RANGE = "motion_out_of_range"
    AFFINE_INVALID = "affine_invalid"
    SIGMA_TOO_LARGE = "sigma_too_large"
    NOT_SIMULTANEOUS = "not_simultaneous"
    CLOSURE_TOO_LARGE = "closure_too_large"
    """Fixed targets seem to have moved by more than the stability budget allows."""
    FIXED_TARGET_MOVED = "fixed_target_moved"
    """A fixed target has moved by itself; its correction is not used."""
    TARGET_NOT_FOUND = "target_not_found"
    """Of a further target: it is hidden, dark or out of the image."""
    TARGET_PARTLY_HIDDEN = "target_partly_hidden"
    TARGET_DISTURBED = "target_disturbed"
    TARGET_NOT_CALIBRATED = "target_not_calibrated"
    """Of a further target: the reference of the calibration does not show it."""
    NO_CALIBRATION = "no_calibration"
    INTERNAL_ERROR = "internal_error"
    """The program broke on this pair; its log says where. The frames are kept."""


@dataclass(frozen=True, slots=True)
class RigMotion:
    """`T_CSj_CS1`, Eq. 12: the rig at frame j seen from the reference."""

    rotation_rad: FloatArray
    """(3,) rotation vector of R_j."""
    translation_mm: FloatArray
    """(3,) T_j."""
    covariance: FloatArray
    """(6, 6) of (rotation_rad, translation_mm)."""


@dataclass(frozen=True, slots=True)
class Displacement:
    """A displacement of the main target in WM (x right, y up), relative to the reference."""

    mm: FloatArray
    """(2,) x, y."""
    covariance_mm2: FloatArray
    """(2, 2)."""
    shared_mm2: FloatArray | None = None
    """(2, 2) the part of it that is the same in every frame: calibration and reference."""
    image_mm2: FloatArray | None = None
    """(2, 2) the part of it that pixels and calibration give, without what may have changed since
    the calibration; None: all of it."""

    @property
    def by_image_mm2(self) -> FloatArray:
        """(2, 2) that part, whether or not it is all."""
        return self.covariance_mm2 if self.image_mm2 is None else self.image_mm2


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """Figures from the images that let an engineer see how a value came about."""

    discs_found: int = 0
    corners_used: int = 0
    main_residual_px: float | None = None
    """rms of the disc centres about the fitted displacement."""
    sub_residual_px: float | None = None
    """rms of the corners about the fitted pose."""
    main_contrast_dn: float | None = None
    sub_contrast_dn: float | None = None
    main_blur_px: float | None = None
    sub_blur_px: float | None = None


@dataclass(frozen=True, slots=True)
class TargetMeasurement:
    """What a pair, or the pairs of one slot, say of a further target in the main image."""

    name: str
    role: TargetRole
    flag: Flag
    reasons: tuple[Reason, ...]
    corrected: Displacement | None
    """Of a fixed target: what the rig alone says of it, the closure; its true value is 0.
    None when flag is BAD or MISSING."""
    raw: Displacement | None
    """The main camera alone; given whenever the target was found."""
    taken_off: Mapping[str, FloatArray] | None = None
    """Of a fixed target: (2, 4) by the name of each other one: so much of its shift (mm), turn
    (rad) and relative change of scale is taken off that one's displacement. None: not known."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One frame pair, or the pairs of one slot, measured: what a row of the database says."""

    flag: Flag
    reasons: tuple[Reason, ...]
    corrected: Displacement | None
    """None when flag is BAD or MISSING."""
    raw: Displacement | None
    """The main camera alone; given whenever the main target was found."""
    motion: RigMotion | None
    """Given whenever the sub target was found."""
    diagnostics: Diagnostics = field(default_factory=Diagnostics)
    spread_mm: FloatArray | None = None
    """(2,) 1 sigma of one pair of a burst about their mean; None with one pair."""
    frames_used: int = 0
    """Pairs that the value rests on."""
    closure: Displacement | None = None
    """What the fixed targets together say of the rig's error; None where none is believed."""
    targets: tuple[TargetMeasurement, ...] = ()
    """The further targets in the main image, in the order of the config."""


def gains_for(target: str, targets: Sequence[TargetMeasurement]) -> dict[str, FloatArray] | None:
    """What of fixed targets' values is taken off a target: (2, 4) by the fixed one's name.

    None where that is not known.
    """
    fixed = [one for one in targets if one.role is TargetRole.FIXED]
    if any(one.taken_off is None for one in fixed if one.corrected is not None):
        return None
    taken = {one.name: (one.taken_off or {}).get(target) for one in fixed}
    return {name: gain for name, gain in taken.items() if gain is not None}


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """What an engineer needs to decide whether to trust a calibration."""

    passed: bool
    lines: tuple[str, ...]
    """Plain sentences, the verdict first."""
    figures: dict[str, Any]
    """The numbers behind them, plain JSON types."""
