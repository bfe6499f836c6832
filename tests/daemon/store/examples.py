"""Small, complete values for the store's tests."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from core.calibration.calibrate import CalibrationReport
from core.results import (
    Diagnostics,
    Displacement,
    Flag,
    Measurement,
    Reason,
    RigMotion,
    TargetMeasurement,
)
from core.site import TargetRole
from daemon.store.records import (
    CalibrationRecord,
    CameraState,
    DatumMethod,
    DatumRecord,
    DatumStep,
    MeasurementRecord,
    Reading,
)
from drivers.protocols import CapturedFrame, CapturedPair

START = datetime(2026, 3, 1, tzinfo=UTC)
PERIOD_S = 60
READINGS = (
    Reading("steel-2", "degC", -3.25),
    Reading("air", "degC", None, "no answer for 5 s"),
)
"""In no order of their names."""


def slot(number: int, start: datetime = START) -> datetime:
    """Slots once a minute."""
    return start + timedelta(seconds=PERIOD_S * number)


FIXED = TargetMeasurement(
    "abutment",
    TargetRole.FIXED,
    Flag.GOOD,
    (),
    corrected=Displacement(np.array([0.03, -0.04]), np.array([[0.01, 0.002], [0.002, 0.0225]])),
    raw=Displacement(np.array([2.5, -3.5]), np.array([[0.09, 0.003], [0.003, 0.16]])),
)
MEASURED = TargetMeasurement(
    "quarter-span",
    TargetRole.MEASURED,
    Flag.SUSPECT,
    (Reason.TARGET_PARTLY_HIDDEN, Reason.TARGET_DISTURBED),
    corrected=Displacement(
        np.array([0.7, -0.8]),
        np.array([[0.36, 0.004], [0.004, 0.49]]),
        image_mm2=np.array([[0.0004, 0.0001], [0.0001, 0.0009]]),
    ),
    raw=Displacement(np.array([4.5, -5.5]), np.array([[0.64, 0.005], [0.005, 0.81]])),
)
HIDDEN = TargetMeasurement(
    "abutment", TargetRole.FIXED, Flag.BAD, (Reason.TARGET_NOT_FOUND,), corrected=None, raw=None
)


def full_measurement() -> Measurement:
    """Every field has a value of its own."""
    half = np.arange(36.0).reshape(6, 6) / 7.0
    return Measurement(
        flag=Flag.SUSPECT,
        reasons=(Reason.TOO_DARK, Reason.MAIN_TARGET_PARTLY_HIDDEN),
        corrected=Displacement(
            np.array([0.1, -0.2]),
            np.array([[0.04, 0.01], [0.01, 0.09]]),
            image_mm2=np.array([[0.0025, 0.001], [0.001, 0.0036]]),
        ),
        raw=Displacement(np.array([1.1, -1.2]), np.array([[0.16, -0.02], [-0.02, 0.25]])),
        motion=RigMotion(np.array([1e-3, -2e-3, 3e-3]), np.array([0.1, -0.2, 0.3]), half + half.T),
        diagnostics=Diagnostics(5, 870, 0.01, 0.02, 180.5, 190.5, 1.1, 1.2),
        spread_mm=np.array([0.05, 0.06]),
        frames_used=5,
        closure=Displacement(np.array([0.03, -0.04]), np.array([[0.01, 0.002], [0.002, 0.0225]])),
        targets=(FIXED, MEASURED),
    )


BAD = Measurement(
    flag=Flag.BAD,
    reasons=(Reason.MAIN_TARGET_NOT_FOUND,),
    corrected=None,
    raw=None,
    motion=None,
)


def record(slot_utc: datetime, measurement: Measurement = BAD) -> MeasurementRecord:
    """A row with what it must have."""
    return MeasurementRecord(slot_utc, measurement, config_hash="c0ffee", version="0.1.0")


def full_record(slot_utc: datetime, calibration_id: int | None = None) -> MeasurementRecord:
    """A row with everything."""
    return MeasurementRecord(
        slot_utc=slot_utc,
        measurement=full_measurement(),
        config_hash="c0ffee",
        version="0.1.0",
        calibration_id=calibration_id,
        skew_s=-0.0012,
        main_frame="frames/2026/03/01/000000_main.png",
        sub_frame="frames/2026/03/01/000000_sub.png",
        captured_utc=slot_utc + timedelta(microseconds=1234),
        boot_id="7c9f8a3e-0000-4000-8000-00805f9b34fb",
        uptime_s=86_400.25,
        clock_synchronised=False,
        redated_from_utc=slot_utc - timedelta(days=900),
        recorded_late=True,
        main_camera=CameraState(10_000.5, 3.0, 41.5),
        sub_camera=CameraState(800.25, 0.0, 39.0),
        readings=READINGS,
    )


def calibration(content: dict[str, object] | None = None) -> CalibrationRecord:
    """A calibration as the store sees it: some JSON and a report."""
    return CalibrationRecord(
        created_utc=START,
        content=content or {"method": "rigid", "focal_px": [1023.25, 1e-17]},
        report=CalibrationReport(
            passed=True, lines=("Good to 0.05 mm.",), figures={"rms_px": 0.03}
        ),
        config_hash="c0ffee",
        version="0.1.0",
        frames="calibrations/20260301T000000Z",
    )


def datum(x_mm: float, y_mm: float, sigma_mm: float = 0.1) -> DatumRecord:
    """A link given by hand."""
    offset = Displacement(np.array([x_mm, y_mm]), np.diag([sigma_mm**2, sigma_mm**2]))
    step = DatumStep(DatumMethod.SURVEY, None, offset)
    return DatumRecord(DatumMethod.SURVEY, offset, (step,), START, detail="levelling")


def pair(seed: int = 0) -> CapturedPair:
    """A 12-bit main and an 8-bit sub frame, different for each seed."""
    rng = np.random.default_rng(seed)
    main = rng.integers(0, 4096, (12, 16), dtype=np.uint16)
    sub = rng.integers(0, 256, (10, 8), dtype=np.uint8)
    return CapturedPair(
        main=CapturedFrame(main, 12, 1, 1, 0.0, 10_000.5, 3.0, 41.5),
        sub=CapturedFrame(sub, 8, 1, 1, 0.0, 800.25),
        skew_s=-0.0012,
    )
