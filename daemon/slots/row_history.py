"""Each row held against the rows before it: those of the database, or those just computed."""

from __future__ import annotations

from datetime import datetime

from core.quality.fixed_targets import HISTORY_ROWS, PastRow
from core.quality.residual_ratio import WINDOW_ROWS
from core.quality.step_detection import RowSummary, StepDetector, add_reasons, summarise_row
from core.results import Measurement
from core.rig.stability import Moment
from core.site import QualityLimits, Site, TargetRole
from daemon.slots.measuring import ActiveCalibration, temperature_of_pair
from daemon.store.database import Store
from daemon.store.records import BELIEVED, SLIPPED, MeasurementRecord


class RowHistory:
    """The rows of one calibration in the order of their slots, each judged by those before."""

    def __init__(
        self,
        calibration: ActiveCalibration,
        limits: QualityLimits,
        so_far: StepDetector | None = None,
    ) -> None:
        self._calibrated = calibration.calibration.calibrated
        self._limits = limits
        self.so_far = so_far or StepDetector()

    def judge(self, slot_utc: datetime, measurement: Measurement) -> Measurement:
        """Give the measurement with what the rows before make of it."""
        sample = summarise_row(self._calibrated, measurement, slot_utc.timestamp())
        if sample is None:
            return measurement
        reasons, self.so_far = self.so_far.judge(sample, self._limits)
        return add_reasons(measurement, reasons)


def judge_in_history(
    store: Store,
    calibration: ActiveCalibration | None,
    limits: QualityLimits,
    slot_utc: datetime,
    measurement: Measurement,
) -> Measurement:
    """Judge a new row by the stored rows before its slot. Raises StoreError."""
    if calibration is None or calibration.id is None or measurement.corrected is None:
        return measurement
    so_far = stored_continuity(store, calibration, slot_utc)
    return RowHistory(calibration, limits, so_far).judge(slot_utc, measurement)


def stored_continuity(
    store: Store, calibration: ActiveCalibration, slot_utc: datetime
) -> StepDetector:
    """Give what the database knows of the rows before a slot. Raises StoreError."""
    if calibration.id is None:
        return StepDetector()
    calibrated = calibration.calibration.calibrated

    def sample(row: MeasurementRecord) -> RowSummary | None:
        return summarise_row(calibrated, row.measurement, row.slot_utc.timestamp())

    believed = store.rows_before(slot_utc, calibration.id, BELIEVED, WINDOW_ROWS)
    history = tuple(known for known in map(sample, believed) if known is not None)
    if not believed:
        return StepDetector()
    slipped = store.rows_before(slot_utc, calibration.id, SLIPPED, 1)
    if not slipped or slipped[0].slot_utc < believed[-1].slot_utc:
        return StepDetector.resumed(history, None, None)
    first = store.first_row_after(believed[-1].slot_utc, calibration.id, SLIPPED[0]) or slipped[0]
    return StepDetector.resumed(history, sample(first), sample(slipped[0]))


def past_rows(
    store: Store, calibration: ActiveCalibration | None, site: Site, slot_utc: datetime
) -> list[PastRow]:
    """The last rows before a slot by which fixed targets are judged. Raises StoreError."""
    fixed = any(extra.role is TargetRole.FIXED for extra in site.extra_targets)
    if not fixed or calibration is None or calibration.id is None:
        return []
    return [
        PastRow(record_moment(record), record.measurement)
        for record in store.rows_with_targets(slot_utc, calibration.id, HISTORY_ROWS)
    ]


def record_moment(record: MeasurementRecord) -> Moment:
    """When a row was taken, and how warm the rig was."""
    warm = temperature_of_pair(record.main_camera.temperature_c, record.sub_camera.temperature_c)
    return Moment(record.slot_utc.timestamp(), warm)
