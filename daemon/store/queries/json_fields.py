"""A measurement as JSON shows it, under its columns' names."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from core.results import Measurement, TargetMeasurement
from daemon.store.rows.convert import (
    BURST_COLUMNS,
    RESULT_COLUMNS,
    STABILITY_COLUMNS,
    result_columns,
)
from daemon.store.rows.targets import TARGET_COLUMNS, target_values


def result_fields(slot_utc: datetime, measurement: Measurement) -> dict[str, Any]:
    """A measurement for `--json`: the columns of `reprocess`, with the same names."""
    columns = result_columns(slot_utc, measurement)
    names = (*RESULT_COLUMNS, *STABILITY_COLUMNS, *BURST_COLUMNS)
    return {
        **{name: columns.get(name) for name in names},
        "reasons": [reason.value for reason in measurement.reasons],
        "targets": [target_fields(target) for target in measurement.targets],
    }


def target_fields(target: TargetMeasurement) -> dict[str, Any]:
    """A further target for `--json`, with the names of its columns."""
    values = target_values(target)
    return {
        "name": target.name,
        **{name: values.get(name) for name in TARGET_COLUMNS},
        "reasons": [reason.value for reason in target.reasons],
    }
