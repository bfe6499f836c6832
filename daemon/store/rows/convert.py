"""Records to rows and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from core.arrays import FloatArray
from core.results import (
    CalibrationReport,
    Diagnostics,
    Flag,
    Measurement,
    RigMotion,
)
from daemon.errors import DamagedRowError
from daemon.store.records import CalibrationRecord, CameraState, MeasurementRecord, Reading
from daemon.store.rows.displacements import (
    corrected_columns,
    displacement_columns,
    displacement_of,
    finite,
)
from daemon.store.rows.targets import join_reasons, split_reasons, targets_of, targets_text

if TYPE_CHECKING:  # SQLAlchemy is loaded by who needs its rows
    from daemon.store.schema import CalibrationRow

RESULT_COLUMNS = (
    *("slot_utc", "flag", "reasons", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm"),
    *("raw_x_mm", "raw_y_mm", "rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"),
)
"""What `reprocess` writes; the interface that scripts rely on."""

STABILITY_COLUMNS = ("sigma_image_x_mm", "sigma_image_y_mm", "closure_x_mm", "closure_y_mm")
"""What `reprocess` appends to them: sigma without the stability budget, and the closure."""

BURST_COLUMNS = ("spread_x_mm", "spread_y_mm", "frames_used")
"""What `reprocess` writes last where slots have several pairs."""

_UPPER = np.triu_indices(6)
_DIAGNOSTICS = tuple(field.name for field in fields(Diagnostics))
_MOTION = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
_AS_STORED = (
    *("config_hash", "version", "calibration_id", "skew_s", "main_frame", "sub_frame"),
    *("boot_id", "uptime_s"),
)
"""Columns that are fields of the record under their own names."""
_CAMERA = tuple(field.name for field in fields(CameraState))


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
        **corrected_columns(measurement.corrected),
        **displacement_columns(measurement.raw, "raw_"),
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
        **displacement_columns(measurement.closure, "closure_"),
        "targets": targets_text(measurement.targets),
        "readings": _readings_column(record.readings),
    }


def result_columns(slot_utc: datetime, measurement: Measurement) -> dict[str, Any]:
    """The columns of a measurement that is not in the database; as `measurement_columns`.

    Raises ValueError.
    """
    record = MeasurementRecord(slot_utc, measurement, config_hash="", version="")
    columns = measurement_columns(record)
    for axis in "xy":
        columns.setdefault(f"sigma_image_{axis}_mm", columns.get(f"sigma_{axis}_mm"))
    return columns


def measurement_record(values: Mapping[str, Any]) -> MeasurementRecord:
    """The record of a row of `measurement`: its values by column, as SQLite holds them.

    Raises DamagedRowError for a time that is none.
    """
    measurement = Measurement(
        flag=Flag(values["flag"]),
        reasons=split_reasons(values["reasons"]),
        corrected=displacement_of(values),
        raw=displacement_of(values, "raw_"),
        motion=_motion(values),
        diagnostics=Diagnostics(**{name: values[name] for name in _DIAGNOSTICS}),
        spread_mm=_spread(values),
        frames_used=values["frames_used"],
        closure=displacement_of(values, "closure_"),
        targets=targets_of(values["targets"]),
    )
    synchronised = values["clock_synchronised"]
    return MeasurementRecord(
        slot_utc=stored_time(values["slot_utc"]),
        measurement=measurement,
        captured_utc=_time_or_none(values["captured_utc"]),
        redated_from_utc=_time_or_none(values["redated_from_utc"]),
        clock_synchronised=None if synchronised is None else bool(synchronised),
        recorded_late=bool(values["recorded_late"]),
        main_camera=_camera(values, "main_"),
        sub_camera=_camera(values, "sub_"),
        readings=stored_readings(values["readings"]),
        **{name: values[name] for name in _AS_STORED},
    )


def stored_time(text: Any) -> datetime:
    """A time that SQLite holds. Raises DamagedRowError for what is none."""
    try:
        return datetime.fromisoformat(text)
    except (ValueError, TypeError) as error:
        msg = f"{text!r} is no time"
        raise DamagedRowError(msg) from error


def _time_or_none(text: str | None) -> datetime | None:
    return None if text is None else stored_time(text)


def _readings_column(readings: tuple[Reading, ...]) -> str | None:
    """JSON: name to [value, unit], or to [null, unit, cause]."""
    if not readings:
        return None
    finite({one.name: one.value for one in readings if one.value is not None})
    return _json(
        {
            one.name: [one.value, one.unit, *([one.cause] if one.value is None else [])]
            for one in readings
        }
    )


def stored_readings(text: str | None) -> tuple[Reading, ...]:
    """The readings of a row's column."""
    if text is None:
        return ()
    return tuple(
        Reading(name, unit, value, *cause)
        for name, (value, unit, *cause) in json.loads(text).items()
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


def _json(value: object) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _spread_columns(spread_mm: FloatArray | None) -> dict[str, float]:
    if spread_mm is None:
        return {}
    return finite({"spread_x_mm": float(spread_mm[0]), "spread_y_mm": float(spread_mm[1])})


def _spread(values: Mapping[str, Any]) -> FloatArray | None:
    if values["spread_x_mm"] is None:
        return None
    return np.array([values["spread_x_mm"], values["spread_y_mm"]], dtype=np.float64)


def _motion_columns(motion: RigMotion | None) -> dict[str, Any]:
    if motion is None:
        return {}
    numbers = [*motion.rotation_rad.tolist(), *motion.translation_mm.tolist()]
    columns = finite(dict(zip(_MOTION, numbers, strict=True)))
    return {**columns, "motion_covariance": _json(motion.covariance[_UPPER].tolist())}


def _motion(values: Mapping[str, Any]) -> RigMotion | None:
    if values["motion_covariance"] is None:
        return None
    covariance: FloatArray = np.zeros((6, 6))
    covariance[_UPPER] = json.loads(values["motion_covariance"])
    covariance = covariance + np.triu(covariance, 1).T
    return RigMotion(
        rotation_rad=np.array([values[name] for name in _MOTION[:3]], dtype=np.float64),
        translation_mm=np.array([values[name] for name in _MOTION[3:]], dtype=np.float64),
        covariance=covariance,
    )


def _camera_columns(camera: CameraState, prefix: str) -> dict[str, float | None]:
    return {prefix + name: getattr(camera, name) for name in _CAMERA}


def _camera(values: Mapping[str, Any], prefix: str) -> CameraState:
    return CameraState(**{name: values[prefix + name] for name in _CAMERA})
