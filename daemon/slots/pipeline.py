"""One slot, from the trigger to the acknowledgement: whatever fails becomes a row or a gap.

`Slot -> frame pairs -> frames on the disk -> measurement -> row committed -> acknowledged`. Daemon,
demo and the recovery after a crash go this way; `capture` and `reprocess` measure alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime

import structlog

from core.results import Measurement
from core.site import Site
from daemon.burst import BurstPlan, Shot, take_burst
from daemon.clock.machine import Machine, this_machine
from daemon.errors import StoreError
from daemon.readings.changes import Changes
from daemon.readings.sampler import Sampler
from daemon.retention.guard import DiskGuard
from daemon.slots.exposure import ExposureLoop
from daemon.slots.identity import made_by
from daemon.slots.learner import Learner
from daemon.slots.measuring import (
    ActiveCalibration,
    ImagePair,
    active_calibration,
    image_pair,
    load_pairs,
    worst_skew_s,
)
from daemon.slots.row_history import measure_in_record, slip_that_began
from daemon.slots.supervision import Action, Policy, policy_of
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive, StoredPair, camera_state
from daemon.store.records import DatumRecord, GapCause, MeasurementRecord, Reading
from daemon.store.rows.datum import in_record_zero
from daemon.times import slot_text
from drivers.errors import DeviceError, DeviceLostError, DriverError
from drivers.protocols import Clock, FramePairSource, Role

_log = structlog.get_logger("dcam.daemon")

RETRY_WITHIN_S = 1.0
"""A pair that failed later than this after the slot's begin is not tried again."""


@dataclass(frozen=True, slots=True)
class Missed:
    """A slot that got no row, and why."""

    slot_utc: datetime
    cause: GapCause
    detail: str
    policy: Policy | None = None
    """What is done about the error; None where there was none."""
    cameras: tuple[Role, ...] = ()
    """Those that gave no frame."""


@dataclass(frozen=True, slots=True)
class SlotContext:
    """What a slot passes through; the same for every slot of a run."""

    site: Site
    config_hash: str
    store: Store
    archive: FrameArchive
    clock: Clock
    disk: DiskGuard
    burst: BurstPlan = field(default_factory=BurstPlan)
    exposure: ExposureLoop | None = None
    """What follows the light from slot to slot; None where exposure is fixed."""
    readings: Sampler = field(default_factory=Sampler)
    """The sensors, asked ahead of each slot."""
    learner: Learner = field(default_factory=Learner)
    """What fixed targets taught of the rig."""
    changes: Changes | None = None
    """Tells which readings have begun to fail; None where nobody is told."""
    machine: Machine = field(default_factory=this_machine)
    undated: bool = False
    """Whether the clock is before the last slot: pairs are kept apart then, until their slots are
    known; the archive is one of its own, below the state directory."""
    late_row_done: Callable[[datetime], None] = lambda _slot_utc: None
    """Called with each pair that was measured late: many of them take their time."""


def run_slot(
    context: SlotContext, slot_utc: datetime, source: FramePairSource
) -> MeasurementRecord | Missed:
    """Take, keep, measure and record one slot; never raises for what a slot can meet.

    A `MeasurementRecord` is on the disk and has been acknowledged. A `Missed` slot has no row; to
    put it into a gap is the caller's part.
    """
    started_s = context.clock.monotonic_s()
    synchronised = context.machine.clock_synchronised()
    try:
        shots = _take(context, slot_utc, source, started_s)
    except Exception as error:  # noqa: BLE001 - whatever a driver raises costs this slot only
        return _missed(slot_utc, error, GapCause.CAPTURE_FAILED)
    readings = context.readings.collect(slot_utc)
    try:
        stored = _keep_frames(context, slot_utc, shots, readings)
        calibration = active_calibration(context.store)
        record = _measure_captured(context, slot_utc, shots, stored, calibration, readings)
        record = replace(record, clock_synchronised=synchronised)
        _follow_light(context, source, shots, record.measurement, calibration)
        add = context.store.add_undated if context.undated else context.store.add_measurement
        context.disk.with_room(lambda: add(record))
    except Exception as error:  # noqa: BLE001 - as above; frames that were kept are measured late
        return _missed(slot_utc, error, GapCause.STORAGE_FAILED)
    note_slip(context, record, calibration)
    _acknowledge(context, record, calibration.datum if calibration else None, started_s)
    if context.changes is not None:
        context.changes.note(readings)
    return record


def record_late(context: SlotContext, slot_utc: datetime) -> MeasurementRecord:
    """Measure the pair of a slot that was left without a row, and record it under its slot.

    Raises StoreError.
    """
    started_s = context.clock.monotonic_s()
    record = measure_stored(context, slot_utc)
    datum = context.store.datum(record.calibration_id)
    context.store.add_measurement(record)
    note_slip(context, record, active_calibration(context.store))
    _acknowledge(context, record, datum, started_s)
    context.late_row_done(slot_utc)
    return record


def measure_stored(context: SlotContext, slot_utc: datetime) -> MeasurementRecord:
    """Measure a slot's pairs of the archive with the active calibration; nothing is written.

    Damaged pairs alone give a bad row without frames, its reason says so. Raises StoreError.
    """
    calibration = active_calibration(context.store)
    pairs, first = load_pairs(context.archive, slot_utc)
    record = MeasurementRecord(
        slot_utc=slot_utc,
        measurement=_measure(context, slot_utc, pairs, calibration),
        config_hash=context.config_hash,
        version=made_by(),
        calibration_id=calibration.id if calibration else None,
        recorded_late=True,
    )
    if first is None:
        return record
    return replace(
        record,
        skew_s=worst_skew_s(pairs),
        main_frame=first.stored.main_path,
        sub_frame=first.stored.sub_path,
        captured_utc=first.captured_utc,
        main_camera=first.main_camera,
        sub_camera=first.sub_camera,
        readings=context.readings.of_stored(first.readings),
    )


def _measure_captured(
    context: SlotContext,
    slot_utc: datetime,
    shots: Sequence[Shot],
    stored: StoredPair | None,
    calibration: ActiveCalibration | None,
    readings: tuple[Reading, ...],
) -> MeasurementRecord:
    pairs = [image_pair(shot.pair, slot_utc, readings) for shot in shots]
    first = shots[0].pair
    return MeasurementRecord(
        slot_utc=slot_utc,
        measurement=_measure(context, slot_utc, pairs, calibration),
        config_hash=context.config_hash,
        version=made_by(),
        calibration_id=calibration.id if calibration else None,
        skew_s=worst_skew_s(pairs),
        main_frame=_in_state(context, stored.main_path) if stored else None,
        sub_frame=_in_state(context, stored.sub_path) if stored else None,
        captured_utc=shots[0].captured_utc,
        boot_id=context.machine.boot_id,
        uptime_s=context.machine.uptime_s() - (context.clock.monotonic_s() - shots[0].captured_s),
        main_camera=camera_state(first.main),
        sub_camera=camera_state(first.sub),
        readings=readings,
    )


def _measure(
    context: SlotContext,
    slot_utc: datetime,
    pairs: Sequence[ImagePair],
    calibration: ActiveCalibration | None,
) -> Measurement:
    return measure_in_record(
        *(context.store, context.site, calibration, context.learner, slot_utc, pairs),
        undated=context.undated,
    )


def note_slip(
    context: SlotContext, record: MeasurementRecord, calibration: ActiveCalibration | None
) -> None:
    """Write into the history since when the board has been elsewhere, at the first row marked."""
    try:
        slip = None if context.undated else slip_that_began(context.store, calibration, record)
        if slip is not None:
            context.store.add_event(context.clock.now_utc(), "board_slipped", slip)
    except StoreError as error:  # the row is stored, and says it too
        _log.warning("slip_not_noted", slot=slot_text(record.slot_utc), error=str(error))


def _in_state(context: SlotContext, path: str) -> str:
    """A path of the archive as one of the state directory."""
    return (context.archive.state / path).relative_to(context.store.path.parent).as_posix()


def _follow_light(
    context: SlotContext,
    source: FramePairSource,
    shots: Sequence[Shot],
    measurement: Measurement,
    calibration: ActiveCalibration | None,
) -> None:
    """Set the next slot's exposure by this one's; whatever goes wrong leaves it as it is."""
    if context.exposure is None:
        return
    calibrated = calibration.calibration.calibrated if calibration else None
    try:
        context.exposure.follow(source, [shot.pair for shot in shots], measurement, calibrated)
    except Exception:  # noqa: BLE001 - a fault of ours costs the adjustment, not the row
        _log.exception("exposure_not_followed")


def _keep_frames(
    context: SlotContext, slot_utc: datetime, shots: Sequence[Shot], readings: Sequence[Reading]
) -> StoredPair | None:
    """Put the frames on the disk and give the first pair's places.

    Where there is no room for them the measurement goes on alone, and its row names none; of a
    burst those stay that found room.
    """
    first: StoredPair | None = None
    values = {one.name: one.value for one in readings}
    try:
        for shot in shots:
            context.disk.require_room()
            taken = shot.pair, shot.captured_utc, shot.number
            stored = context.archive.store(slot_utc, *taken, values)
            first = first or stored
    except StoreError as error:
        context.disk.frames_refused(slot_utc, error)
        return first
    context.disk.frames_kept(slot_utc)
    return first


def _acknowledge(
    context: SlotContext, record: MeasurementRecord, datum: DatumRecord | None, started_s: float
) -> None:
    """Say that the slot is done, in the record's zero; only of a row that is on the disk."""
    measurement = in_record_zero(record.measurement, datum)
    displacement = measurement.corrected
    x_mm, y_mm = displacement.mm.round(4).tolist() if displacement else (None, None)
    _log.info(
        "slot_done",
        slot=slot_text(record.slot_utc),
        flag=int(measurement.flag),
        reasons="+".join(measurement.reasons),
        x_mm=x_mm,
        y_mm=y_mm,
        late=record.recorded_late,
        undated=context.undated,
        took_s=round(context.clock.monotonic_s() - started_s, 3),
    )


def _take(
    context: SlotContext, slot_utc: datetime, source: FramePairSource, started_s: float
) -> list[Shot]:
    """Take the slot's pairs; what may be tried once more is, if that does not make them late."""
    try:
        return take_burst(source, context.clock, slot_utc, context.burst)
    except DriverError as error:
        passed_s = context.clock.monotonic_s() - started_s
        if policy_of(error).action is not Action.RETRY or passed_s > RETRY_WITHIN_S:
            raise
        _log.warning("capture_tried_again", slot=slot_text(slot_utc), error=str(error))
        first = error
    try:
        return take_burst(source, context.clock, slot_utc, context.burst)
    except DeviceLostError:  # given up by now, for what it did before: that is why there is no pair
        raise first from None


def _missed(slot_utc: datetime, error: Exception, otherwise: GapCause) -> Missed:
    """Say which slot was missed, and why; `otherwise` is the cause of what nobody foresaw."""
    policy = policy_of(error)
    cause, detail = policy.cause, str(error)
    if cause is GapCause.UNKNOWN:
        cause, detail = otherwise, f"{type(error).__name__}: {error}"
        _log.error("slot_broke", slot=slot_text(slot_utc), exc_info=error)
    _log.warning("slot_missed", slot=slot_text(slot_utc), cause=cause.value, detail=detail)
    cameras: tuple[Role, ...] = ()
    if isinstance(error, DeviceError):
        cameras = (error.role,) if error.role else ("main", "sub")
    return Missed(slot_utc, cause, detail, policy, cameras)
