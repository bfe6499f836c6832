"""Each row held against the rows before it: those of the database, or those just computed."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from functools import partial

import numpy as np

from core.quality.fixed_targets import HISTORY_ROWS, PastRow
from core.quality.residual_ratio import residual_ratio
from core.quality.row_series import RowSeries, slide_by_translation, summarise_row
from core.quality.step_detection import (
    SETTLED_ROWS,
    USUAL_ROWS,
    BoardSlip,
    StepDetector,
    add_reasons,
)
from core.results import Measurement, Reason
from core.rig.calibrated_site import CalibratedSite
from core.site import QualityLimits, Site
from daemon.slots.learner import Learner
from daemon.slots.measuring import ActiveCalibration, ImagePair, measure
from daemon.store.database import ALWAYS, NEVER, Store
from daemon.store.records import BELIEVED, SLIPPED, MeasurementRecord, PastRows
from daemon.times import slot_text

_SECOND = timedelta(seconds=1)


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


def measure_in_record(
    store: Store,
    site: Site,
    calibration: ActiveCalibration | None,
    learner: Learner,
    slot_utc: datetime,
    pairs: Sequence[ImagePair],
    *,
    undated: bool = False,
) -> Measurement:
    """Measure a slot's pairs and hold the result against the rows before; nothing is written.

    Those are the rows before the slot in time that `store` knows: one that was written later, or
    has its values as of a wrong clock's time, is none of them.
    An undated slot is held against all rows, and nothing learnt serves it. Raises StoreError.
    """
    before_utc = NEVER if undated else slot_utc
    past = past_rows(store, calibration, site, before_utc)
    learnt = None
    if not undated and calibration is not None and calibration.id is not None:
        hours = partial(store.hourly_closures, calibration.id)
        learnt = learner.at(slot_utc, calibration, hours, store.state_before)
    alone = measure(pairs, site, calibration, past, learnt)
    return judge_in_history(store, calibration, site.quality, before_utc, alone)


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
    so_far = stored_step_detector(store, calibration, slot_utc)
    return RowHistory(calibration, limits, so_far).judge(slot_utc, measurement)


def slip_that_began(
    store: Store, calibration: ActiveCalibration | None, record: MeasurementRecord
) -> str | None:
    """Say of a stored row that is the first one marked for a slip since when, and how far.

    Raises StoreError.
    """
    if calibration is None or Reason.BOARD_SLIPPED not in record.measurement.reasons:
        return None
    slip = stored_step_detector(store, calibration, record.slot_utc + _SECOND).slip
    return _slip_text(slip) if slip is not None and len(slip.rows) == 1 else None


def _slip_text(slip: BoardSlip) -> str:
    since_utc = datetime.fromtimestamp(slip.since_s, UTC)
    x_mm, y_mm = slip.by_mm
    return f"since {slot_text(since_utc)}, x {x_mm:+.3f} y {y_mm:+.3f} mm of false displacement"


def stored_step_detector(
    store: Store, calibration: ActiveCalibration, slot_utc: datetime
) -> StepDetector:
    """Give what the database knows of the rows before a slot. Raises StoreError."""
    if calibration.id is None:
        return StepDetector()
    calibrated = calibration.calibration.calibrated
    history = _series(
        calibrated, store.past_rows(calibration.id, BELIEVED, USUAL_ROWS, ALWAYS, slot_utc)
    )
    if not len(history):
        return StepDetector()
    after_utc = datetime.fromtimestamp(history.time_s[-1], UTC) + _SECOND
    first, last = (
        _series(
            calibrated,
            store.past_rows(calibration.id, SLIPPED, rows, after_utc, slot_utc, newest=newest),
        )
        for rows, newest in ((1, False), (SETTLED_ROWS, True))
    )
    later = int(np.searchsorted(last.time_s, first.time_s, side="right").sum())
    return StepDetector.resumed(history, first.followed_by(last[later:]))


def _series(calibrated: CalibratedSite, rows: PastRows) -> RowSeries:
    """Give stored rows as later ones need them; how sure slide and closure were is not read."""
    baseline = calibrated.baseline
    sigma_mm = rows.sigma_mm.max(axis=1, initial=0.0)
    return RowSeries.of_columns(
        rows.time_s,
        {
            "mm": rows.mm,
            "false_mm": rows.raw_mm - rows.mm - np.nan_to_num(rows.closure_mm),
            "slide_mm": rows.translation_mm @ slide_by_translation(calibrated).T,
            "closure_mm": rows.closure_mm,
        },
        {"mm": sigma_mm, "false_mm": sigma_mm},
        np.array(
            [
                residual_ratio(baseline.sub_rms_px, baseline.sub_contrast_dn, *seen)
                for seen in zip(
                    np.nan_to_num(rows.sub_residual_px).tolist(),
                    np.nan_to_num(rows.sub_contrast_dn).tolist(),
                    strict=True,
                )
            ]
        ),
    )


def past_rows(
    store: Store, calibration: ActiveCalibration | None, site: Site, slot_utc: datetime
) -> list[PastRow]:
    """The last rows before a slot by which fixed targets are judged. Raises StoreError."""
    if not site.has_fixed_target or calibration is None or calibration.id is None:
        return []
    return [
        PastRow(record.moment, record.measurement)
        for record in store.rows_with_targets(slot_utc, calibration.id, HISTORY_ROWS)
    ]
