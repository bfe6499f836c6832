"""One slot, from the trigger to the acknowledgement: whatever fails becomes a row or a gap.

`Slot -> frame pair -> frames on the disk -> measurement -> row committed -> acknowledged`. The
daemon, `capture`, `reprocess`, the demo and the recovery after a crash all measure by this module.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import structlog

from core.calibration import Calibration
from core.errors import CalibrationError, ImageError
from core.frames import GreyImage, require_size
from core.measurement import measure_pair
from core.quality import flag_of
from core.results import Flag, Measurement, Reason
from core.site import CameraGeometry, Site
from daemon.store.database import Store
from daemon.store.errors import DiskFullError, StoreError
from daemon.store.frames import FrameArchive, StoredPair, camera_state
from daemon.store.records import GapCause, MeasurementRecord
from daemon.store.schema import slot_text
from daemon.version import VERSION
from drivers.errors import (
    DeviceLostError,
    DriverError,
    FrameSetError,
    FrameTimeoutError,
    ImageMissingError,
)
from drivers.frameset import read_image
from drivers.protocols import CapturedPair, Clock, FramePairSource, Role

_log = structlog.get_logger("dcam.daemon")

_MISSING = {"main": Reason.MAIN_IMAGE_MISSING, "sub": Reason.SUB_IMAGE_MISSING}
_UNREADABLE = {"main": Reason.MAIN_IMAGE_UNREADABLE, "sub": Reason.SUB_IMAGE_UNREADABLE}


@dataclass(frozen=True, slots=True)
class ActiveCalibration:
    """The calibration that rows are measured with, and its number in the database."""

    id: int | None
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class Missed:
    """A slot that got no row, and why."""

    slot_utc: datetime
    cause: GapCause
    detail: str


@dataclass(frozen=True, slots=True)
class Pipeline:
    """What a slot passes through; the same for every slot of a run."""

    site: Site
    config_hash: str
    store: Store
    archive: FrameArchive
    clock: Clock


def run_slot(
    line: Pipeline, slot_utc: datetime, source: FramePairSource
) -> MeasurementRecord | Missed:
    """Take, keep, measure and record one slot; never raises for what a slot can meet.

    A `MeasurementRecord` is on the disk and has been acknowledged. A `Missed` slot has no row; to
    put it into a gap is the caller's part.
    """
    began_utc, started_s = line.clock.now_utc(), line.clock.monotonic_s()
    try:
        pair = source.capture(slot_utc)
    except DriverError as error:
        return _missed(slot_utc, _cause_of(error), str(error))
    except Exception as error:  # noqa: BLE001 - a driver's fault costs this slot, not the daemon
        _log.exception("capture_broke", slot=slot_text(slot_utc))
        return _missed(slot_utc, GapCause.CAPTURE_FAILED, f"{type(error).__name__}: {error}")
    captured_utc = max(began_utc, _captured_utc(line.clock, pair))
    stored = _keep_frames(line, slot_utc, pair, captured_utc)
    try:
        record = _measure_captured(line, slot_utc, pair, stored, captured_utc)
        line.store.add_measurement(record)
    except StoreError as error:
        return _missed(slot_utc, _cause_of(error), str(error))
    _acknowledge(line, record, started_s)
    return record


def record_late(line: Pipeline, slot_utc: datetime) -> MeasurementRecord:
    """Measure the pair of a slot that was left without a row, and record it under its slot.

    Raises StoreError.
    """
    started_s = line.clock.monotonic_s()
    record = measure_stored(line, slot_utc)
    line.store.add_measurement(record)
    _acknowledge(line, record, started_s)
    return record


def measure_stored(line: Pipeline, slot_utc: datetime) -> MeasurementRecord:
    """Measure a pair of the archive with the active calibration; nothing is written.

    A damaged pair gives a bad row without frames, its reason says so. Raises StoreError.
    """
    calibration = active_calibration(line.store)
    record = MeasurementRecord(
        slot_utc=slot_utc,
        measurement=_bad(*_UNREADABLE.values()),
        config_hash=line.config_hash,
        version=VERSION,
        calibration_id=calibration.id if calibration else None,
        recorded_late=True,
    )
    try:
        pair = line.archive.load(slot_utc)
    except FrameSetError as error:
        _log.warning("stored_pair_damaged", slot=slot_text(slot_utc), error=str(error))
        return record
    return replace(
        record,
        measurement=measure_images(pair.main, pair.sub, line.site, calibration, pair.skew_s),
        skew_s=pair.skew_s,
        main_frame=pair.stored.main_path,
        sub_frame=pair.stored.sub_path,
        captured_utc=pair.captured_utc,
        main_camera=pair.main_camera,
        sub_camera=pair.sub_camera,
    )


def measure_files(
    main: Path | None,
    sub: Path | None,
    site: Site,
    calibration: ActiveCalibration | None,
    skew_s: float | None = None,
) -> Measurement:
    """Measure a pair of image files; one that is missing or damaged is a reason, not an error."""
    images: dict[Role, GreyImage | None] = {"main": None, "sub": None}
    unreadable: set[Role] = set()
    paths: tuple[tuple[Role, Path | None], ...] = (("main", main), ("sub", sub))
    for role, path in paths:
        try:
            images[role] = read_image(path) if path else None
            _note_size(images[role], site.main if role == "main" else site.sub, path)
        except ImageMissingError as error:
            _log.warning("image_missing", error=str(error))
        except FrameSetError as error:
            _log.warning("image_unreadable", error=str(error))
            unreadable.add(role)
    return measure_images(
        images["main"], images["sub"], site, calibration, skew_s, frozenset(unreadable)
    )


def _note_size(image: GreyImage | None, camera: CameraGeometry, path: Path | None) -> None:
    """Log which file has another size than the config says; the core gives the reason."""
    if image is None:
        return
    try:
        require_size(image, camera, str(path))
    except ImageError as error:
        _log.warning("image_wrong_size", error=str(error))


def measure_images(
    main: GreyImage | None,
    sub: GreyImage | None,
    site: Site,
    calibration: ActiveCalibration | None,
    skew_s: float | None = None,
    unreadable: frozenset[Role] = frozenset(),
) -> Measurement:
    """Measure one pair; every pair gets an answer, if only a reason.

    None means no image: not there, or there and `unreadable`.
    """
    if calibration is None:
        return _bad(Reason.NO_CALIBRATION)
    try:
        measurement = measure_pair(main, sub, site, calibration.calibration, skew_s)
    except Exception:  # noqa: BLE001 - a fault of ours costs this value, not the row
        _log.exception("measurement_broke")
        return _bad(Reason.INTERNAL_ERROR)
    said = {_MISSING[role]: _UNREADABLE[role] for role in unreadable}
    reasons = tuple(said.get(reason, reason) for reason in measurement.reasons)
    flag = flag_of(reasons, has_value=measurement.corrected is not None)
    return replace(measurement, flag=flag, reasons=reasons)


def active_calibration(store: Store) -> ActiveCalibration | None:
    """Give the calibration in use, None when there is none or it cannot be read."""
    record = store.active_calibration()
    if record is None:
        return None
    try:
        return ActiveCalibration(record.id, record.calibration)
    except CalibrationError as error:
        _log.error("calibration_unreadable", calibration=record.id, error=str(error))
        return None


def _measure_captured(
    line: Pipeline,
    slot_utc: datetime,
    pair: CapturedPair,
    stored: StoredPair | None,
    captured_utc: datetime,
) -> MeasurementRecord:
    calibration = active_calibration(line.store)
    return MeasurementRecord(
        slot_utc=slot_utc,
        measurement=measure_images(
            GreyImage(pair.main.pixels, pair.main.bits),
            GreyImage(pair.sub.pixels, pair.sub.bits),
            line.site,
            calibration,
            pair.skew_s,
        ),
        config_hash=line.config_hash,
        version=VERSION,
        calibration_id=calibration.id if calibration else None,
        skew_s=pair.skew_s,
        main_frame=stored.main_path if stored else None,
        sub_frame=stored.sub_path if stored else None,
        captured_utc=captured_utc,
        main_camera=camera_state(pair.main),
        sub_camera=camera_state(pair.sub),
    )


def _keep_frames(
    line: Pipeline, slot_utc: datetime, pair: CapturedPair, captured_utc: datetime
) -> StoredPair | None:
    """Put the frames on the disk; without space for them the measurement goes on alone."""
    try:
        return line.archive.store(slot_utc, pair, captured_utc)
    except StoreError as error:
        _log.error("frames_not_kept", slot=slot_text(slot_utc), error=str(error))
        return None


def _acknowledge(line: Pipeline, record: MeasurementRecord, started_s: float) -> None:
    """Say that the slot is done; only of a row that is on the disk."""
    measurement, displacement = record.measurement, record.measurement.corrected
    x_mm, y_mm = displacement.mm.round(4).tolist() if displacement else (None, None)
    _log.info(
        "slot_done",
        slot=slot_text(record.slot_utc),
        flag=int(measurement.flag),
        reasons="+".join(measurement.reasons),
        x_mm=x_mm,
        y_mm=y_mm,
        late=record.recorded_late,
        took_s=round(line.clock.monotonic_s() - started_s, 3),
    )


def _missed(slot_utc: datetime, cause: GapCause, detail: str) -> Missed:
    _log.warning("slot_missed", slot=slot_text(slot_utc), cause=cause.value, detail=detail)
    return Missed(slot_utc, cause, detail)


def _cause_of(error: DriverError | StoreError) -> GapCause:
    if isinstance(error, DeviceLostError | FrameTimeoutError):
        return GapCause.CAMERA_LOST
    if isinstance(error, DriverError):
        return GapCause.CAPTURE_FAILED
    return GapCause.DISK_FULL if isinstance(error, DiskFullError) else GapCause.STORAGE_FAILED


def _bad(*reasons: Reason) -> Measurement:
    return Measurement(Flag.BAD, reasons, None, None, None)


def _captured_utc(clock: Clock, pair: CapturedPair) -> datetime:
    """When the main camera was triggered: cameras do not know the time of day.

    A replayed pair was triggered at no time of this clock; its capture's beginning counts.
    """
    ago_s = clock.monotonic_s() - pair.main.trigger_monotonic_s
    return clock.now_utc() - timedelta(seconds=ago_s)
