"""Values as JSON shows them: plain types, and a measurement under its columns' names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any

from core.results import Measurement
from daemon.store.convert import BURST_COLUMNS, RESULT_COLUMNS, measurement_columns
from daemon.store.records import MeasurementRecord
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
    record = MeasurementRecord(slot_utc, measurement, config_hash="", version="")
    columns = measurement_columns(record)
    fields = {name: columns.get(name) for name in RESULT_COLUMNS + BURST_COLUMNS}
    return {**fields, "reasons": [reason.value for reason in measurement.reasons]}
