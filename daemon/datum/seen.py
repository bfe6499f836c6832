"""What is looked at to find a new reference's zero: the calibration before, the new one, rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

from core.calibration.calibrate import Calibration
from core.images import GreyImage
from core.moment import Moment
from core.results import Displacement, RigMotion
from core.rig.reference_errors import Gains, ReferenceErrors
from daemon.slots.measuring import ActiveCalibration
from drivers.protocols import Role


@dataclass(frozen=True, slots=True)
class Known:
    """A calibration that is in the record."""

    active: ActiveCalibration
    reference_utc: datetime
    """When its reference was taken; when it was made, where that is not known."""
    serials: Mapping[Role, str] = field(default_factory=dict)
    """Of the cameras that took it, as far as they are known."""

    @property
    def id(self) -> int:
        """Its number."""
        assert self.active.id is not None  # noqa: S101 - it is stored
        return self.active.id


@dataclass(frozen=True, slots=True)
class NewReference:
    """The reference of a calibration that is not stored yet."""

    slot_utc: datetime
    main: GreyImage | None
    sub: GreyImage
    calibration: Calibration
    moment: Moment | None
    """How warm the rig was then."""
    lens_views_utc: datetime | None
    """When the board was last in somebody's hand, by the lens views."""
    serials: Mapping[Role, str] = field(default_factory=dict)
    """Of the cameras that took it, as far as they are known."""
    errors: ReferenceErrors | None = None
    """What the noise of its images does to all that is measured from it."""


@dataclass(frozen=True, slots=True)
class SeenRow:
    """One row of the record, or a `measure` row of the old frame set."""

    slot_utc: datetime
    displacement: Displacement
    """From its own calibration's reference."""
    calibration_id: int | None
    targets: tuple[tuple[str, Displacement], ...] = ()
    motion: RigMotion | None = None
    """Since the reference of its calibration."""
    gains: Mapping[str, Gains] | None = None
    """By target: what of its fixed targets' values was taken off; None: not known."""
    closure: Displacement | None = None
    """What the rig alone says of the fixed targets; None where none was seen."""
