"""The datum of each calibration, and rows moved by it into the record's one zero.

A stored row counts from the reference of its own calibration and is never changed. Whoever reads
rows for people adds the datum here; a single calibration has none to add.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement, Measurement, TargetMeasurement, gains_for
from core.rig.reference_errors import Gains, ReferenceErrors
from core.site import MAIN
from daemon.store.integrity.reading import whole_rows
from daemon.store.records import DatumMethod, DatumRecord, DatumStep
from daemon.store.rows.convert import stored_time
from daemon.store.rows.targets import gains_in, targets_of, targets_text

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
    common_mm2 = common(datum, MAIN, gains_for(MAIN, measurement.targets))
    return replace(
        measurement,
        corrected=moved(measurement.corrected, datum.offset, common_mm2),
        raw=moved(measurement.raw, datum.offset),
        targets=targets_in_record_zero(measurement.targets, datum),
    )


def targets_in_record_zero(
    targets: Sequence[TargetMeasurement], datum: DatumRecord | None
) -> tuple[TargetMeasurement, ...]:
    """Further targets of a row with their own datums added; a fixed one has none."""

    def in_zero(target: TargetMeasurement) -> TargetMeasurement:
        if datum is None or target.name not in datum.targets:
            return target
        offset = datum.targets[target.name]
        common_mm2 = common(datum, target.name, gains_for(target.name, targets))
        corrected = moved(target.corrected, offset, common_mm2)
        return replace(target, corrected=corrected, raw=moved(target.raw, offset))

    return tuple(map(in_zero, targets))


def common(datum: DatumRecord, target: str, gains: Gains | None) -> FloatArray:
    """(2, 2) mm^2: covariance of a row with its datum, both ways; to be added to their sum's.

    The noise of the reference is in both, with opposite signs. gains are what of fixed targets'
    values was taken off the row; where they are not known, nothing is.
    """
    errors, shared = datum.errors, datum.shared.get(target)
    if errors is None or shared is None or (gains is None and errors.has_fixed):
        return np.zeros((2, 2))
    by_errors = errors.by_values(target, gains or {})
    one_way = np.zeros((2, 2)) if by_errors is None else by_errors @ shared
    return np.asarray(-one_way - one_way.T)


def needs_gains(datum: DatumRecord) -> bool:
    """Whether the sigma of its rows in the record's zero depends on their fixed targets."""
    return datum.errors is not None and datum.errors.has_fixed and bool(datum.shared)


def moved(
    displacement: Displacement | None,
    offset: Displacement,
    common_mm2: FloatArray | float = 0.0,
) -> Displacement | None:
    """A displacement with an offset and its covariance added; None stays None.

    common_mm2 (2, 2) is added for what both have in common.
    """
    if displacement is None:
        return None
    whole_mm2 = sum_mm2(displacement.covariance_mm2, offset.covariance_mm2, common_mm2)
    more_mm2 = whole_mm2 - displacement.covariance_mm2
    shared_mm2 = displacement.shared_mm2
    return replace(
        displacement,
        mm=displacement.mm + offset.mm,
        covariance_mm2=whole_mm2,
        shared_mm2=None if shared_mm2 is None else shared_mm2 + more_mm2,
    )


def sum_mm2(
    row_mm2: FloatArray, datum_mm2: FloatArray, common_mm2: FloatArray | float
) -> FloatArray:
    """(2, 2) covariance of a row and its datum together.

    No correlation makes a variance less than the square of the difference of both sigmas.
    """
    whole_mm2 = row_mm2 + datum_mm2 + common_mm2
    least = (np.sqrt(np.diag(row_mm2)) - np.sqrt(np.diag(datum_mm2))) ** 2
    return np.asarray(whole_mm2 + np.diag(np.maximum(least - np.diag(whole_mm2), 0.0)))


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
    added = list(map(_added_to(MAIN), links, columns["targets"]))
    changed: dict[str, Sequence[Any]] = dict(columns)
    for prefix in ("", "raw_"):
        for axis, letter in enumerate(_AXES):
            changed |= _changed(columns, f"{prefix}{letter}_mm", added, _plus(axis))
            name = f"{prefix}sigma_{letter}_mm"
            widened = _widened(axis, has_common=not prefix)
            changed |= _changed(columns, name, added, widened)
        more = _more_covariance(has_common=not prefix)
        changed |= _changed(columns, f"{prefix}cov_xy_mm2", added, more)
    changed["targets"] = [
        _moved_text(text, link) if link is not None and text is not None else text
        for text, link in zip(columns["targets"], links, strict=True)
    ]
    return changed


@dataclass(frozen=True, slots=True)
class Added:
    """What a row gets of its datum."""

    offset: Displacement
    common_mm2: FloatArray
    """(2, 2) as `common` gives it."""


def _added_to(target: str) -> Callable[[DatumRecord | None, str | None], Added | None]:
    alike: dict[int, Added] = {}

    def added(link: DatumRecord | None, text: str | None) -> Added | None:
        if link is None:
            return None
        if needs_gains(link):
            return Added(link.offset, common(link, target, gains_in(text, target)))
        if id(link) not in alike:
            alike[id(link)] = Added(link.offset, common(link, target, {}))
        return alike[id(link)]

    return added


def _moved_text(text: str, datum: DatumRecord) -> str | None:
    return targets_text(targets_in_record_zero(targets_of(text), datum)) if datum.targets else text


_Change = Callable[[float, Added], float]


def _changed(
    columns: Mapping[str, Sequence[Any]],
    name: str,
    added: Sequence[Added | None],
    change: _Change,
) -> dict[str, Sequence[Any]]:
    return {
        name: [
            value if value is None or more is None else change(value, more)
            for value, more in zip(columns[name], added, strict=True)
        ]
    }


def _plus(axis: int) -> _Change:
    return lambda value, more: float(value + more.offset.mm[axis])


def _widened(axis: int, *, has_common: bool) -> _Change:
    def widened(value: float, more: Added) -> float:
        common_mm2 = more.common_mm2[axis, axis] if has_common else 0.0
        return sum_sigma_mm(value, more.offset.covariance_mm2[axis, axis], common_mm2)

    return widened


def sum_sigma_mm(row_mm: float, datum_mm2: float, common_mm2: float) -> float:
    """1 sigma of a row and its datum together, along one axis; as `sum_mm2`."""
    least = row_mm - math.sqrt(datum_mm2)
    return math.sqrt(max(row_mm**2 + datum_mm2 + common_mm2, least**2))


def _more_covariance(*, has_common: bool) -> _Change:
    def more_covariance(value: float, more: Added) -> float:
        common_mm2 = more.common_mm2[0, 1] if has_common else 0.0
        return float(value + more.offset.covariance_mm2[0, 1] + common_mm2)

    return more_covariance


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
        "reference_errors": _errors_text(record),
    }


def _errors_text(record: DatumRecord) -> str | None:
    errors = record.errors
    if errors is None:
        return None
    found = {
        "targets": list(zip(errors.names, errors.fixed, strict=True)),
        "covariance": errors.covariance.tolist(),
        "shared": {name: shared.tolist() for name, shared in record.shared.items()},
    }
    return json.dumps(found, allow_nan=False)


def _errors(text: str | None) -> tuple[ReferenceErrors | None, dict[str, FloatArray]]:
    if text is None:
        return None, {}
    found = json.loads(text)
    names, fixed = zip(*found["targets"], strict=True)
    errors = ReferenceErrors(tuple(names), tuple(fixed), np.array(found["covariance"]))
    return errors, {name: np.array(shared) for name, shared in found["shared"].items()}


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
        **{
            name: _gains_fields(gains)
            for name, gains in (("now", step.now), ("before", step.before))
            if gains is not None
        },
    }


def _gains_fields(gains: Mapping[str, Gains]) -> dict[str, dict[str, list[list[float]]]]:
    return {
        target: {name: np.asarray(gain).tolist() for name, gain in by_name.items()}
        for target, by_name in gains.items()
    }


def _gains(fields: Mapping[str, Any] | None) -> dict[str, Gains] | None:
    if fields is None:
        return None
    return {
        target: {name: np.array(gain) for name, gain in by_name.items()}
        for target, by_name in fields.items()
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
        now=_gains(fields.get("now")),
        before=_gains(fields.get("before")),
    )


def _record(row: Mapping[str, Any]) -> DatumRecord:
    reference = row["reference_utc"]
    errors, shared = _errors(row["reference_errors"])
    return DatumRecord(
        method=DatumMethod(row["method"]),
        offset=_offset(row),
        steps=tuple(map(_step, json.loads(row["steps"]))),
        created_utc=stored_time(row["created_utc"]),
        reference_utc=None if reference is None else stored_time(reference),
        targets=_offsets(json.loads(row["targets"])),
        errors=errors,
        shared=shared,
        detail=row["detail"],
        calibration_id=row["calibration_id"],
        id=row["id"],
    )
