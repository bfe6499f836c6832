"""Values as JSON shows them: plain types, and a measurement under its columns' names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any

from core.results import Measurement, TargetMeasurement
from daemon.store.rows.convert import (
    BURST_COLUMNS,
    RESULT_COLUMNS,
    STABILITY_COLUMNS,
    result_columns,
)
from daemon.store.rows.targets import TARGET_COLUMNS, target_values
from daemon.text import utc_text


def plain(value: Any) -> Any:
    """Give plain JSON types: times in ISO 8601, None for a number that is none."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, datetime):
        return utc_text(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


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
