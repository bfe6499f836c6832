"""From calibration views to a calibration: lens, board, reference, rig, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from core.frames import GreyImage
from core.site import Site


class ViewRole(StrEnum):
    """What a calibration view is for (the `role` column of frames.csv)."""

    INTRINSICS = "intrinsics"
    REFERENCE = "reference"
    RIG = "rig"


class Method(StrEnum):
    """The dual calibration's model."""

    RIGID = "rigid"
    PAPER = "paper"


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """One view given to `calibrate`."""

    name: str
    """How messages call it, e.g. the slot or the file name."""
    role: ViewRole
    main: GreyImage | None
    sub: GreyImage


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything that `measure_pair` needs; immutable; round-trips through plain JSON types."""

    method: Method

    def to_dict(self) -> dict[str, Any]:
        """Give plain JSON types."""
        raise NotImplementedError

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Calibration:
        """Read what `to_dict` gave."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """What an engineer needs to decide whether to trust a calibration."""

    passed: bool
    lines: tuple[str, ...]
    """Plain sentences, the verdict first."""
    figures: dict[str, Any]
    """The numbers behind them, plain JSON types."""


def calibrate(
    views: Sequence[CalibrationView], site: Site, method: Method = Method.RIGID
) -> tuple[Calibration, CalibrationReport]:
    """Calibrate from views. Raises CalibrationError, NotObservableError."""
    raise NotImplementedError
