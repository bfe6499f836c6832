"""A row as programs elsewhere get it: names and units as in an export."""

from __future__ import annotations

import hashlib
import re
from typing import Any

from core.results import Flag
from daemon.store.queries.arrivals import Arrival
from daemon.store.queries.json_fields import target_fields
from daemon.store.rows.convert import RESULT_COLUMNS, STABILITY_COLUMNS, stored_readings
from daemon.store.rows.targets import targets_of

SCHEMA = 1

NUMBERS = (
    *(name for name in RESULT_COLUMNS if name not in {"slot_utc", "flag", "reasons"}),
    *STABILITY_COLUMNS,
    *("spread_x_mm", "spread_y_mm", "main_temperature_c", "sub_temperature_c"),
)
"""Columns with numbers; a row leaves out those that it does not have."""
COUNTS = ("calibration_id", "discs_found", "corners_used", "frames_used")
"""Columns with whole numbers."""

_MOST_OF_A_NAME = 48


def slug(site: str) -> str:
    """A site's name made of letters, digits, `-` and `_`; two names never become one."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "-", site).strip("-")[:_MOST_OF_A_NAME]
    if plain == site:
        return plain
    mark = hashlib.sha256(site.encode()).hexdigest()[:6]
    return f"{plain}-{mark}" if plain else f"site-{mark}"


def row_fields(row: Arrival, site: str) -> dict[str, Any]:
    """A row as one JSON object; what it does not have is null."""
    values = row.values
    return {
        "schema": SCHEMA,
        "site": site,
        "slot_utc": row.slot,
        "flag": values["flag"],
        "quality": Flag(values["flag"]).name.lower(),
        "reasons": _words(values["reasons"]),
        **{name: values[name] for name in (*NUMBERS, *COUNTS)},
        "recorded_late": bool(values["recorded_late"]),
        "redated_from_utc": values["redated_from_utc"],
        "config_hash": values["config_hash"],
        "version": values["version"],
        "targets": [target_fields(target) for target in targets_of(values["targets"])],
        "readings": {
            one.name: {"value": one.value, "unit": one.unit}
            for one in stored_readings(values["readings"])
        },
    }


def _words(reasons: str) -> list[str]:
    return reasons.split("+") if reasons else []
