"""What the store takes and gives: plain frozen values, free of SQL."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from core.arrays import FloatArray
from core.moment import Moment
from core.results import CalibrationReport, Displacement, Measurement, Reason
from core.rig.reference_errors import Gains, ReferenceErrors

if TYPE_CHECKING:
    from core.calibration.calibrate import Calibration

BELIEVED = ("", Reason.CALIBRATION_DRIFTING.value)
"""Reasons, as the table holds them, of the rows that later ones are judged by."""
SLIPPED = (Reason.BOARD_SLIPPED.value,)
"""And of those that show a board that is not where it was calibrated."""

READING_FAILED, READING_BACK = "reading_failed", "reading_back"
"""Kinds of events; the detail begins with the reading's name and a colon."""


class GapCause(StrEnum):
    """Why slots have no row: a closed list."""

    POWER_LOSS = "power_loss"
    CRASH = "crash"
    STOPPED = "stopped"
    """Stopped by an operator, or by a shutdown of the machine."""
    CAMERA_LOST = "camera_lost"
    CAPTURE_FAILED = "capture_failed"
    """The cameras were there, but gave no complete pair."""
    DISK_FULL = "disk_full"
    STORAGE_FAILED = "storage_failed"
    """The pair was taken, but disk or database refused it for another reason than space."""
    CLOCK_WRONG = "clock_wrong"
    CALIBRATION = "calibration"
    OVERRUN = "overrun"
    """The slot before took too long."""
    UNKNOWN = "unknown"


class Mark(StrEnum):
    """The few single values that survive a restart."""

    HEARTBEAT_UTC = "heartbeat_utc"
    CLEAN_STOP_UTC = "clean_stop_utc"
    BOOT_ID = "boot_id"
    SCHEMA = "schema"
    """Revision and digests of the tables' definitions, as the last migration left them."""
    IDENTITY = "identity"
    """A name that no other database has: a log that bears another is not this one's."""
    SCHEDULES = "schedules"
    """The schedules that the site had, and from when on: which slots there were."""
    SALVAGED = "salvaged"
    """What was lost with a damaged database; until recovery has accounted for the lost slots."""
    ABSENCE = "absence"
    """JSON: why there was no daemon before this boot; for a clock that is put right later."""
    MOVING_TO_UTC = "moving_to_utc"
    """The slot whose frames are on their way from where a wrong clock had put them."""


@dataclass(frozen=True, slots=True)
class CameraState:
    """What one camera said of itself at the exposure; None where it has no such figure."""

    exposure_us: float | None = None
    gain_db: float | None = None
    temperature_c: float | None = None


@dataclass(frozen=True, slots=True)
class Reading:
    """What a sensor said at a slot, or why it said nothing that could be stored."""

    name: str
    unit: str
    value: float | None
    cause: str = ""
    """Why there is no value."""


def values_of(readings: Iterable[Reading]) -> dict[str, float]:
    """The readings that have a value, by name."""
    return {one.name: one.value for one in readings if one.value is not None}


def rig_temperature_c(main_c: float | None, sub_c: float | None) -> float | None:
    """The temperature that stands for the rig's: the main camera's, or else the sub-camera's."""
    return sub_c if main_c is None else main_c


@dataclass(frozen=True, slots=True)
class MeasurementRecord:
    """One slot's row: the measurement and everything it was made from."""

    slot_utc: datetime
    """Whole seconds, UTC; unique in the database."""
    measurement: Measurement
    config_hash: str
    version: str
    """Of the software that measured, with a digest of its numerics: `daemon.slots.identity`."""
    calibration_id: int | None = None
    """None only when there was no calibration to measure with."""
    skew_s: float | None = None
    """Sub trigger minus main trigger, s."""
    main_frame: str | None = None
    """Path relative to the state directory, with forward slashes."""
    sub_frame: str | None = None
    captured_utc: datetime | None = None
    """When the pair was triggered; None if a crash left frames without that knowledge."""
    boot_id: str | None = None
    """The kernel's name for the run of the machine in which the pair was taken."""
    uptime_s: float | None = None
    """Seconds since that boot at the capture: they order and space rows whatever the clock says."""
    clock_synchronised: bool | None = None
    """Whether something (NTP, PTP) disciplined the clock; None where the kernel does not tell."""
    redated_from_utc: datetime | None = None
    """The slot that a wrong clock gave it at first; None for nearly all rows."""
    recorded_late: bool = False
    """Made from its kept frames later: found without a row after a restart, or measured again as of
    its true time."""
    main_camera: CameraState = field(default_factory=CameraState)
    sub_camera: CameraState = field(default_factory=CameraState)

    @property
    def moment(self) -> Moment:
        """When it was taken, and how warm the rig was."""
        main_c, sub_c = self.main_camera.temperature_c, self.sub_camera.temperature_c
        warm = rig_temperature_c(main_c, sub_c)
        return Moment(self.slot_utc.timestamp(), warm, self.reading_values)

    readings: tuple[Reading, ...] = ()
    """In the order of the config; empty where there are no sensors."""

    @property
    def reading_values(self) -> dict[str, float]:
        """The readings that have a value, by name."""
        return values_of(self.readings)


class Again(StrEnum):
    """What came of measuring a row again that a wrong clock had dated: a closed list."""

    MEASURED = "measured"
    """Its values are those of its true time now."""
    NO_FRAMES = "no_frames"
    """Its images were not kept, or are removed."""
    UNREADABLE = "frames_unreadable"
    NO_CALIBRATION = "no_calibration"
    """It was measured without one, or that one is lost."""
    BROKE = "broke"
    """A fault of the program; the log has it."""
    MOVED = "moved"
    """It went to another slot before, or became undated."""


@dataclass(frozen=True, slots=True)
class RedatedRecord:
    """What a wrong clock had dated."""

    slot_utc: datetime | None
    """The slot that it got; None of a row that became an undated pair."""
    before: MeasurementRecord
    """As it was before, under the slot that it had."""
    again: Again | None
    """None: it waits to be measured again."""
    seen_by: range
    """The ids of rows that may have been held against it as it was."""


@dataclass(frozen=True, slots=True)
class PastRows:
    """What a new row is held against of rows before it, in order; read far faster than records."""

    time_s: FloatArray
    """(n,) slots, since 1970."""
    mm: FloatArray
    """(n, 2) corrected displacement."""
    raw_mm: FloatArray
    """(n, 2)."""
    translation_mm: FloatArray
    """(n, 3) of the rig."""
    sigma_mm: FloatArray
    """(n, 2) of the corrected displacement, by pixels and calibration."""
    closure_mm: FloatArray
    """(n, 2) nan without a fixed target that is believed."""
    sub_residual_px: FloatArray
    """(n,) nan where there is none."""
    sub_contrast_dn: FloatArray
    """(n,) likewise."""


@dataclass(frozen=True, slots=True)
class GapRecord:
    """A run of missed slots, `first + k * period_s`, with one cause."""

    first_slot_utc: datetime
    last_slot_utc: datetime
    """The last missed slot, not the first one after."""
    period_s: int
    cause: GapCause
    detail: str = ""

    @property
    def slots(self) -> int:
        """The number of missed slots, at least 1."""
        span = self.last_slot_utc - self.first_slot_utc
        return span // timedelta(seconds=self.period_s) + 1


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """One calibration as stored: immutable once it has its id."""

    created_utc: datetime
    content: Mapping[str, Any]
    """`Calibration.to_dict()`: plain JSON types, finite numbers."""
    report: CalibrationReport
    config_hash: str
    version: str
    frames: str | None = None
    """The directory of its frame set, relative to the state directory or as the user gave it."""
    id: int | None = None
    """Given by the database."""

    @property
    def calibration(self) -> Calibration:
        """The calibration that `core.measurement` takes."""
        from core.calibration.calibrate import Calibration  # loads all of the numerics

        return Calibration.from_dict(dict(self.content))


class DatumMethod(StrEnum):
    """How the datum of a calibration was found: a closed list."""

    ORIGIN = "origin"
    """No calibration before it: its reference is the zero."""
    SAME_REFERENCE = "same_reference"
    """The reference is another calibration's, too: the same images, adjusted again."""
    OLD_CALIBRATION = "old_calibration"
    """The calibration before measured the new reference."""
    FIXED_TARGETS = "fixed_targets"
    """Fixed targets were seen in both references."""
    ROWS = "rows"
    """The last good row before the new reference; the bridge's movement since is in the sigma."""
    ADJUSTED = "adjusted"
    """Several links and frames that two calibrations measured, by least squares."""
    SURVEY = "survey"
    """Given by hand."""
    LOST = "lost"
    """Nothing tells; the sigma says how far it may be off."""


@dataclass(frozen=True, slots=True)
class DatumStep:
    """One thing observed of a calibration's reference: where it lies from another's."""

    method: DatumMethod
    from_id: int | None
    """The calibration whose reference it counts from; None: from the record's zero."""
    offset: Displacement | None
    """Of the main target; None where only further targets were observed."""
    targets: Mapping[str, Displacement] = field(default_factory=dict)
    """Of the measured further targets, by name."""
    now: Mapping[str, Gains] | None = None
    """By target, where the reference itself was measured: what of its fixed targets' values was
    taken off. None: it was not, or that is not known."""
    before: Mapping[str, Gains] | None = None
    """Likewise of the reference that the step counts from."""


@dataclass(frozen=True, slots=True)
class DatumRecord:
    """Where a calibration's reference lies in the record's zero: a link, immutable."""

    method: DatumMethod
    offset: Displacement
    """To be added to what the calibration measures; with its covariance."""
    steps: tuple[DatumStep, ...]
    """What the offset rests on; none of where a record begins."""
    created_utc: datetime
    reference_utc: datetime | None = None
    """When the calibration's reference was taken, where that is known."""
    targets: Mapping[str, Displacement] = field(default_factory=dict)
    """The offsets of the measured further targets, by name."""
    detail: str = ""
    """How it was found, for people."""
    calibration_id: int | None = None
    """None as long as its calibration is not stored."""
    id: int | None = None
    """Given by the database; the newest link of a calibration holds."""
    errors: ReferenceErrors | None = None
    """What the noise of the calibration's reference does to all its rows; None: not known."""
    shared: Mapping[str, FloatArray] = field(default_factory=dict)
    """(m, 2) by target: covariance of these errors with the target's offset."""


class Thinning(StrEnum):
    """How much of a day's frames is kept: a closed list, from all to nothing."""

    EVERY_SLOT = "every_slot"
    HOURLY = "hourly"
    DAILY = "daily"
    EVENTS = "events"
    """Only what is always kept."""
    NOTHING = "nothing"

    @property
    def next(self) -> Thinning:
        """The next step; after the last one it stays."""
        steps = list(Thinning)
        return steps[min(steps.index(self) + 1, len(steps) - 1)]


@dataclass(frozen=True, slots=True)
class FrameDay:
    """What the frame archive holds of a day, and what has been removed of it on purpose."""

    day: date
    level: Thinning = Thinning.EVERY_SLOT
    until_utc: datetime | None = None
    """The last slot that the level has been applied to; None as long as nothing was removed."""
    kept: frozenset[datetime] = frozenset()
    """The slots up to `until_utc` whose frames were there and stay."""
    removed: int = 0
    """Slots whose frames have been removed, in all."""
    bytes: int = 0
    """What the day's directory held when it was last counted."""
    finished: bool = True
    """False from before the first file is removed until the last one is."""

    def has_removed(self, slot_utc: datetime) -> bool:
        """Whether the frames of a slot of this day are missing because they were removed."""
        until_utc = self.until_utc
        return until_utc is not None and slot_utc <= until_utc and slot_utc not in self.kept


@dataclass(frozen=True, slots=True)
class EventRecord:
    """Something that happened to the system, for those who read its history."""

    time_utc: datetime
    kind: str
    """A short snake_case word, e.g. `started`, `camera_back`, `calibration_activated`."""
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Coverage:
    """What became of every slot of a stretch of the schedule."""

    expected: int
    good: int
    suspect: int
    bad: int
    missing: int
    """Rows that say that there was nothing to measure (flag 9)."""
    gaps: Mapping[GapCause, int]
    """Missed slots by cause; causes without any are left out."""
    unaccounted: int
    """Slots with neither row nor gap; anything but 0 is a fault, or a slot still to come."""

    @property
    def measured(self) -> int:
        """Slots with a row, whatever its flag."""
        return self.good + self.suspect + self.bad + self.missing

    @property
    def missed(self) -> int:
        """Slots in gaps."""
        return sum(self.gaps.values())
