"""The statement of uncertainty: the budget of one row of the record, and the check of it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

import core
import daemon
import drivers
from core.analysis.budget import Budget, DatumPart, RowState
from core.analysis.monte_carlo import MonteCarlo, monte_carlo
from core.analysis.row_budget import row_budget
from core.arrays import FloatArray
from core.calibration.calibrate import Calibration
from core.errors import CalibrationError
from core.geometry.pose import Pose
from core.results import Displacement, Measurement, Reason, TargetMeasurement, gains_for
from core.rig.stability import Term, main_scale, stability_terms, total_covariance
from core.site import MAIN, Site, TargetRole
from daemon.store.database import Store
from daemon.store.records import CalibrationRecord, DatumRecord, MeasurementRecord
from daemon.store.rows.datum import in_record_zero, needs_gains

TRIALS = 5000
"""Of the Monte Carlo in a report, at most: its standard deviation is then known to 1.0 %."""
_SEED = 101
"""Of the Monte Carlo, so that a report can be made again."""
_LEARNT_SHARE = 0.9
"""A row without a believed fixed target whose stability part is below this share of the budget's
was measured with what fixed targets had taught."""


@dataclass(frozen=True, slots=True)
class Statement:
    """The uncertainty of one row."""

    record: MeasurementRecord
    """As stored."""
    value: Displacement
    """In the record's zero, with the covariance that the row carries."""
    budget: Budget
    drawn: MonteCarlo | None
    """None with the paper's method."""
    calibration: CalibrationRecord
    datum: DatumRecord | None
    is_config_of_row: bool
    """Whether the config is the one that the row was measured with."""

    @property
    def difference(self) -> FloatArray:
        """(2,) relative: the budget's combined uncertainty over the row's own sigma, less 1."""
        row = np.sqrt(np.diag(self.value.covariance_mm2))
        return np.asarray(np.sqrt(np.diag(self.budget.covariance_mm2)) / row - 1.0)


def make_statement(
    store: Store,
    site: Site,
    config_hash: str,
    slot_utc: datetime,
    tell: Callable[[int, int], None] = lambda _done, _total: None,
    trials: int = TRIALS,
) -> Statement | str:
    """Make the statement of a row with a value; or say why there is none. Raises StoreError."""
    record = store.measurement(slot_utc)
    if record is None or record.measurement.corrected is None:
        return "the row has no value"
    if record.calibration_id is None or record.measurement.motion is None:
        return "the row names no calibration"
    stored, datum = store.calibration(record.calibration_id), store.datum(record.calibration_id)
    if stored is None:
        return f"calibration {record.calibration_id} is not in the database"
    try:
        calibration = stored.calibration
    except CalibrationError as error:
        return str(error)
    state = _row_state(record.measurement)
    if MAIN not in state.raw_mm2:
        return "the row has no raw displacement"
    terms = _terms(site, calibration, record, state)
    part = _datum_part(datum, record.measurement)
    budget = row_budget(site, calibration.calibrated, state, terms, part)
    value = in_record_zero(record.measurement, datum).corrected
    assert value is not None  # noqa: S101 - it has one as stored
    drawn = monte_carlo(budget, trials, np.random.default_rng(_SEED), tell) if trials else None
    is_same = record.config_hash == config_hash
    return Statement(record, value, budget, drawn, stored, datum, is_same)


def _row_state(measurement: Measurement) -> RowState:
    assert measurement.motion is not None  # noqa: S101 - asked before
    motion, raw = measurement.motion, {}
    if measurement.raw is not None:
        raw[MAIN] = measurement.raw
    raw |= {one.name: one.raw for one in measurement.targets if one.raw is not None}
    believed = [one.name for one in measurement.targets if _is_believed(one)]
    return RowState(
        Pose.from_vectors(motion.rotation_rad, motion.translation_mm),
        motion.covariance,
        {name: one.covariance_mm2 for name, one in raw.items()},
        {name: one.mm for name, one in raw.items()},
        believed if measurement.closure is not None else (),
        measurement.diagnostics.corners_used,
        None if measurement.corrected is None else measurement.corrected.by_image_mm2,
    )


def _datum_part(datum: DatumRecord | None, measurement: Measurement) -> DatumPart | None:
    if datum is None or not datum.steps:
        return None
    covariance_mm2, shared = datum.offset.covariance_mm2, datum.shared.get(MAIN)
    if needs_gains(datum) and gains_for(MAIN, measurement.targets) is None:
        return DatumPart(covariance_mm2)
    return DatumPart(covariance_mm2, datum.errors, shared)


def _is_believed(target: TargetMeasurement) -> bool:
    return (
        target.role is TargetRole.FIXED
        and target.corrected is not None
        and Reason.FIXED_TARGET_MOVED not in target.reasons
    )


def _terms(
    site: Site, calibration: Calibration, record: MeasurementRecord, state: RowState
) -> Sequence[Term]:
    """What may have changed, as the row was measured: by the budget, or as fixed targets taught."""
    corrected = record.measurement.corrected
    if calibration.reference is None or corrected is None or corrected.image_mm2 is None:
        return ()
    calibrated = calibration.calibrated
    scale = main_scale(calibrated.B)
    terms = stability_terms(site, scale, calibration.reference, record.moment, calibrated.lens)
    part_mm2 = corrected.covariance_mm2 - corrected.image_mm2
    shift_px2 = calibrated.B @ part_mm2 @ calibrated.B.T
    whole = total_covariance(terms)
    expected_px2 = whole[:2, :2] + whole[4:, 4:]
    if state.believed or np.trace(shift_px2) >= _LEARNT_SHARE * np.trace(expected_px2):
        return terms
    rest = whole.copy()
    rest[:2] = rest[:, :2] = 0.0
    learnt = np.zeros_like(whole)
    values, vectors = np.linalg.eigh(shift_px2 - rest[4:, 4:])
    learnt[:2, :2] = vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T
    return (
        Term("the cameras' turn, as fixed targets had taught it", learnt, ""),
        Term("roll, scale and the air's temperature gradient", rest, ""),
    )


def calibration_hash(record: CalibrationRecord) -> str:
    """SHA-256 of what a calibration holds."""
    text = json.dumps(dict(record.content), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def software_hash() -> str:
    """SHA-256 of this program's modules, by name and content."""
    whole = hashlib.sha256()
    for package in (core, daemon, drivers):
        folder = Path(str(package.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            whole.update(f"{package.__name__}/{path.relative_to(folder).as_posix()}\0".encode())
            whole.update(path.read_bytes())
    return whole.hexdigest()


def expected_span(statement: Statement) -> float | None:
    """Days from the calibration's reference to the row."""
    try:
        reference = statement.calibration.calibration.reference
    except CalibrationError:
        return None
    if reference is None:
        return None
    return math.fabs(statement.record.moment.utc_s - reference.utc_s) / 86_400.0
