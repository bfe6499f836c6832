"""Records to rows and back."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from core.arrays import FloatArray
from core.results import (
    CalibrationReport,
    Diagnostics,
    Displacement,
    Flag,
    Measurement,
    Reason,
    RigMotion,
)
from daemon.store.records import CalibrationRecord, CameraState, MeasurementRecord

if TYPE_CHECKING:  # SQLAlchemy is loaded by who needs its rows
    from types import SimpleNamespace

    from daemon.store.schema import CalibrationRow, MeasurementRow

RESULT_COLUMNS = (
    *("slot_utc", "flag", "reasons", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm"),
    *("raw_x_mm", "raw_y_mm", "rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"),
)
"""What `reprocess` writes; the interface that scripts rely on."""

BURST_COLUMNS = ("spread_x_mm", "spread_y_mm", "frames_used")
"""What `reprocess` appends where slots have several pairs."""

_UPPER = np.triu_indices(6)
_DIAGNOSTICS = tuple(field.name for field in fields(Diagnostics))
_MOTION = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
_CAMERA = tuple(field.name for field in fields(CameraState))


def measurement_row(record: MeasurementRecord) -> MeasurementRow:
    """The row of a record. Raises ValueError for a value or covariance that is not finite."""
    from daemon.store.schema import MeasurementRow

    return MeasurementRow(**measurement_columns(record))


def measurement_columns(record: MeasurementRecord) -> dict[str, Any]:
    """The columns of a record's row; those that it has no value for are left out.

    Raises ValueError for a value or covariance that is not finite.
    """
    measurement = record.measurement
    diagnostics = measurement.diagnostics
    return {
        "slot_utc": record.slot_utc,
        "flag": int(measurement.flag),
        "reasons": join_reasons(measurement.reasons),
        **_displacement_columns(measurement.corrected, ""),
        **_displacement_columns(measurement.raw, "raw_"),
        **_motion_columns(measurement.motion),
        **{name: getattr(diagnostics, name) for name in _DIAGNOSTICS},
        **_spread_columns(measurement.spread_mm),
        "frames_used": measurement.frames_used,
        **_camera_columns(record.main_camera, "main_"),
        **_camera_columns(record.sub_camera, "sub_"),
        "skew_s": record.skew_s,
        "main_frame": record.main_frame,
        "sub_frame": record.sub_frame,
        "captured_utc": record.captured_utc,
        "boot_id": record.boot_id,
        "uptime_s": record.uptime_s,
        "clock_synchronised": record.clock_synchronised,
        "redated_from_utc": record.redated_from_utc,
        "recorded_late": record.recorded_late,
        "calibration_id": record.calibration_id,
        "config_hash": record.config_hash,
        "version": record.version,
    }


def measurement_record(row: MeasurementRow | SimpleNamespace) -> MeasurementRecord:
    """The record of a row, or of its columns by name."""
    measurement = Measurement(
        flag=Flag(row.flag),
        reasons=tuple(Reason(word) for word in row.reasons.split("+") if word),
        corrected=_displacement(row, ""),
        raw=_displacement(row, "raw_"),
        motion=_motion(row),
        diagnostics=Diagnostics(**{name: getattr(row, name) for name in _DIAGNOSTICS}),
        spread_mm=_spread(row),
        frames_used=row.frames_used,
    )
    return MeasurementRecord(
        slot_utc=row.slot_utc,
        measurement=measurement,
        config_hash=row.config_hash,
        version=row.version,
        calibration_id=row.calibration_id,
        skew_s=row.skew_s,
        main_frame=row.main_frame,
        sub_frame=row.sub_frame,
        captured_utc=row.captured_utc,
        boot_id=row.boot_id,
        uptime_s=row.uptime_s,
        clock_synchronised=row.clock_synchronised,
        redated_from_utc=row.redated_from_utc,
        recorded_late=row.recorded_late,
        main_camera=_camera(row, "main_"),
        sub_camera=_camera(row, "sub_"),
    )


def calibration_row(record: CalibrationRecord) -> CalibrationRow:
    """The row of a calibration. Raises ValueError for content that is not plain, finite JSON."""
    from daemon.store.schema import CalibrationRow

    report = {"lines": list(record.report.lines), "figures": record.report.figures}
    return CalibrationRow(
        created_utc=record.created_utc,
        method=str(record.content.get("method", "")),
        passed=record.report.passed,
        content=_json(dict(record.content)),
        report=_json(report),
        frames=record.frames,
        config_hash=record.config_hash,
        version=record.version,
    )


def calibration_record(row: CalibrationRow) -> CalibrationRecord:
    """The record of a calibration's row."""
    report = json.loads(row.report)
    return CalibrationRecord(
        created_utc=row.created_utc,
        content=json.loads(row.content),
        report=CalibrationReport(
            passed=row.passed, lines=tuple(report["lines"]), figures=report["figures"]
        ),
        config_hash=row.config_hash,
        version=row.version,
        frames=row.frames,
        id=row.id,
    )


def join_reasons(reasons: tuple[Reason, ...]) -> str:
    """Reasons as one word of a table."""
    return "+".join(reason.value for reason in reasons)


def _json(value: object) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _displacement_columns(displacement: Displacement | None, prefix: str) -> dict[str, float]:
    if displacement is None:
        return {}
    covariance = displacement.covariance_mm2
    columns = {
        f"{prefix}x_mm": float(displacement.mm[0]),
        f"{prefix}y_mm": float(displacement.mm[1]),
        f"{prefix}sigma_x_mm": math.sqrt(covariance[0, 0]),
        f"{prefix}sigma_y_mm": math.sqrt(covariance[1, 1]),
        f"{prefix}cov_xy_mm2": float(covariance[0, 1]),
    }
    return _finite(columns)


def _displacement(row: MeasurementRow | SimpleNamespace, prefix: str) -> Displacement | None:
    names = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "cov_xy_mm2")
    x, y, sigma_x, sigma_y, cov_xy = (getattr(row, prefix + name) for name in names)
    if x is None:
        return None
    covariance = np.array([[sigma_x**2, cov_xy], [cov_xy, sigma_y**2]])
    return Displacement(mm=np.array([x, y]), covariance_mm2=covariance)


def _spread_columns(spread_mm: FloatArray | None) -> dict[str, float]:
    if spread_mm is None:
        return {}
    return _finite({"spread_x_mm": float(spread_mm[0]), "spread_y_mm": float(spread_mm[1])})


def _spread(row: MeasurementRow | SimpleNamespace) -> FloatArray | None:
    if row.spread_x_mm is None:
        return None
    return np.array([row.spread_x_mm, row.spread_y_mm], dtype=np.float64)


def _motion_columns(motion: RigMotion | None) -> dict[str, Any]:
    if motion is None:
        return {}
    numbers = [*motion.rotation_rad.tolist(), *motion.translation_mm.tolist()]
    columns = _finite(dict(zip(_MOTION, numbers, strict=True)))
    return {**columns, "motion_covariance": _json(motion.covariance[_UPPER].tolist())}


def _finite(columns: dict[str, float]) -> dict[str, float]:
    """Pass numbers on. SQLite would make NULL of a NaN, and a value would look withheld."""
    for name, value in columns.items():
        if not math.isfinite(value):
            msg = f"{name} is {value}"
            raise ValueError(msg)
    return columns


def _motion(row: MeasurementRow | SimpleNamespace) -> RigMotion | None:
    if row.motion_covariance is None:
        return None
    covariance: FloatArray = np.zeros((6, 6))
    covariance[_UPPER] = json.loads(row.motion_covariance)
    covariance = covariance + np.triu(covariance, 1).T
    return RigMotion(
        rotation_rad=np.array([row.rx_rad, row.ry_rad, row.rz_rad], dtype=np.float64),
        translation_mm=np.array([row.tx_mm, row.ty_mm, row.tz_mm], dtype=np.float64),
        covariance=covariance,
    )


def _camera_columns(camera: CameraState, prefix: str) -> dict[str, float | None]:
    return {prefix + name: getattr(camera, name) for name in _CAMERA}


def _camera(row: MeasurementRow | SimpleNamespace, prefix: str) -> CameraState:
    return CameraState(**{name: getattr(row, prefix + name) for name in _CAMERA})
