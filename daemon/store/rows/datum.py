"""The datum of each calibration, and rows moved by it into the record's one zero.

A stored row counts from the reference of its own calibration and is never changed. Whoever reads
rows for people adds the datum here; a single calibration has none to add.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from core.results import Displacement, Measurement, TargetMeasurement
from daemon.store.integrity.reading import whole_rows
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from daemon.store.rows.convert import stored_time
from daemon.store.rows.targets import targets_of, targets_text

Datums = Mapping[int, DatumRecord]
"""The link that holds of each calibration that has one, by the calibration's number."""

_AXES = ("x", "y")


def read_links(connection: sqlite3.Connection) -> list[DatumRecord]:
    """All links, oldest first."""
    query = "SELECT * FROM datum ORDER BY id"
    return [_record(row) for row in whole_rows(connection, "datum", query)]


def read_datums(connection: sqlite3.Connection) -> Datums:
    """The link that holds of each calibration."""
    return {int(link.calibration_id or 0): link for link in read_links(connection)}


def datum_of(connection: sqlite3.Connection, calibration_id: int | None) -> DatumRecord | None:
    """The link that holds of one calibration."""
    query = "SELECT * FROM datum WHERE calibration_id = ? ORDER BY id DESC LIMIT 1"
    found = whole_rows(connection, "datum", query, calibration_id)
    return _record(found[0]) if found else None


def in_record_zero(measurement: Measurement, datum: DatumRecord | None) -> Measurement:
    """A measurement with its calibration's datum and covariance added."""
    if datum is None or datum.method is DatumMethod.ORIGIN:
        return measurement
    return replace(
        measurement,
        corrected=moved(measurement.corrected, datum.offset),
        raw=moved(measurement.raw, datum.offset),
        targets=targets_in_record_zero(measurement.targets, datum),
    )


def targets_in_record_zero(
    targets: Sequence[TargetMeasurement], datum: DatumRecord | None
) -> tuple[TargetMeasurement, ...]:
    """Further targets with their own datums added; a fixed one has none."""
    return tuple(
        replace(
            target,
            corrected=moved(target.corrected, datum.targets[target.name]),
            raw=moved(target.raw, datum.targets[target.name]),
        )
        if datum is not None and target.name in datum.targets
        else target
        for target in targets
    )


def moved(displacement: Displacement | None, offset: Displacement) -> Displacement | None:
    """A displacement with an offset and its covariance added; None stays None."""
    if displacement is None:
        return None
    shared_mm2 = displacement.shared_mm2
    return replace(
        displacement,
        mm=displacement.mm + offset.mm,
        covariance_mm2=displacement.covariance_mm2 + offset.covariance_mm2,
        shared_mm2=None if shared_mm2 is None else shared_mm2 + offset.covariance_mm2,
    )


def columns_in_record_zero(
    columns: Mapping[str, Sequence[Any]], datums: Datums
) -> Mapping[str, Sequence[Any]]:
    """Rows, column by column, with the datum of each row's calibration added."""
    moving = {
        number: link for number, link in datums.items() if link.method is not DatumMethod.ORIGIN
    }
    links = [moving.get(number) for number in columns["calibration_id"]]
    if not any(links):
        return columns
    offsets = [link.offset if link else None for link in links]
    changed: dict[str, Sequence[Any]] = dict(columns)
    for prefix in ("", "raw_"):
        for axis, letter in enumerate(_AXES):
            changed |= _changed(columns, f"{prefix}{letter}_mm", offsets, _plus(axis))
            name = f"{prefix}sigma_{letter}_mm"
            changed |= _changed(columns, name, offsets, _widened(axis))
        changed |= _changed(columns, f"{prefix}cov_xy_mm2", offsets, _more_covariance)
    changed["targets"] = [
        _moved_text(text, link) if link is not None and text is not None else text
        for text, link in zip(columns["targets"], links, strict=True)
    ]
    return changed


def _moved_text(text: str, datum: DatumRecord) -> str | None:
    return targets_text(targets_in_record_zero(targets_of(text), datum)) if datum.targets else text


_Change = Callable[[float, Displacement], float]


def _changed(
    columns: Mapping[str, Sequence[Any]],
    name: str,
    offsets: Sequence[Displacement | None],
    change: _Change,
) -> dict[str, Sequence[Any]]:
    return {
        name: [
            value if value is None or offset is None else change(value, offset)
            for value, offset in zip(columns[name], offsets, strict=True)
        ]
    }


def _plus(axis: int) -> _Change:
    return lambda value, offset: float(value + offset.mm[axis])


def _widened(axis: int) -> _Change:
    return lambda value, offset: math.sqrt(value**2 + offset.covariance_mm2[axis, axis])


def _more_covariance(value: float, offset: Displacement) -> float:
    return float(value + offset.covariance_mm2[0, 1])


def datum_columns(record: DatumRecord) -> dict[str, Any]:
    """The columns of a link but for its calibration. Raises ValueError for what is not finite."""
    return {
        "created_utc": record.created_utc,
        "reference_utc": record.reference_utc,
        "method": record.method.value,
        **_numbers(record.offset),
        "targets": json.dumps(_by_name(record.targets)),
        "steps": json.dumps([_step_fields(step) for step in record.steps]),
        "detail": record.detail,
    }


_OFFSET = ("x_mm", "y_mm", "var_x_mm2", "var_y_mm2", "cov_xy_mm2")


def _numbers(offset: Displacement) -> dict[str, float]:
    covariance = offset.covariance_mm2
    numbers = (*offset.mm, covariance[0, 0], covariance[1, 1], covariance[0, 1])
    columns = dict(zip(_OFFSET, map(float, numbers), strict=True))
    for name, number in columns.items():
        if not math.isfinite(number):
            msg = f"datum: {name} is {number}"
            raise ValueError(msg)
    return columns


def _by_name(targets: Mapping[str, Displacement]) -> dict[str, dict[str, float]]:
    return {name: _numbers(offset) for name, offset in targets.items()}


def _step_fields(step: DatumStep) -> dict[str, Any]:
    return {
        "method": step.method.value,
        "from": step.from_id,
        "main": None if step.offset is None else _numbers(step.offset),
        "targets": _by_name(step.targets),
    }


def _offset(values: Mapping[str, Any]) -> Displacement:
    x_mm, y_mm, var_x_mm2, var_y_mm2, cov_xy_mm2 = (values[name] for name in _OFFSET)
    covariance_mm2 = np.array([[var_x_mm2, cov_xy_mm2], [cov_xy_mm2, var_y_mm2]])
    return Displacement(np.array([x_mm, y_mm]), covariance_mm2)


def _offsets(by_name: Mapping[str, Any]) -> dict[str, Displacement]:
    return {name: _offset(values) for name, values in by_name.items()}


def _step(fields: Mapping[str, Any]) -> DatumStep:
    main = fields["main"]
    return DatumStep(
        method=DatumMethod(fields["method"]),
        from_id=fields["from"],
        offset=None if main is None else _offset(main),
        targets=_offsets(fields["targets"]),
    )


def _record(row: Mapping[str, Any]) -> DatumRecord:
    reference = row["reference_utc"]
    return DatumRecord(
        method=DatumMethod(row["method"]),
        offset=_offset(row),
        steps=tuple(map(_step, json.loads(row["steps"]))),
        created_utc=stored_time(row["created_utc"]),
        reference_utc=None if reference is None else stored_time(reference),
        targets=_offsets(json.loads(row["targets"])),
        detail=row["detail"],
        calibration_id=row["calibration_id"],
        id=row["id"],
    )
