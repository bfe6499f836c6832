"""The sensors that rows have readings of, and their values in many rows at once."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from daemon.store.integrity.reading import fetch
from daemon.store.runs import next_second
from daemon.store.sqlite import connect_readonly, said_plainly
from daemon.times import slot_text
from drivers.frameset import READING

CAUSES = "readings_missing"
"""The column of an export that says why readings have no value: `deck: no answer ...; ...`."""

_SENSORS = """
SELECT one.key, json_extract(one.value, '$[1]'), max(slot_utc), min(one.id)
FROM measurement, json_each(measurement.readings) AS one
WHERE slot_utc >= ? AND slot_utc < ? AND json_valid(readings)
GROUP BY 1, 2 ORDER BY min(slot_utc), min(one.id)
"""


_COLUMN = re.compile(rf"{READING}[a-z0-9-]+(_in_\w+)?")


@dataclass(frozen=True, slots=True)
class Sensor:
    """A reading's name and unit: a name whose unit was changed is two."""

    name: str
    unit: str
    column: str
    """Its column in a table."""


def is_reading(column: str) -> bool:
    """Whether a column of a table holds readings."""
    return _COLUMN.fullmatch(column) is not None


def sensors_within(path: Path, since: datetime, until: datetime) -> tuple[Sensor, ...]:
    """The sensors of rows with since <= slot < until, in the order in which they came.

    Raises StoreError.
    """
    limits = [slot_text(next_second(time)) for time in (since, until)]
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        return _named(connection, limits)


def _named(connection: sqlite3.Connection, limits: Sequence[str]) -> tuple[Sensor, ...]:
    found = fetch(connection, _SENSORS, *limits)
    newest = {name: last for name, _, last, _ in sorted(found, key=lambda row: str(row[2]))}
    sensors = []
    for name, unit, last, _ in found:
        column = f"{READING}{name}"
        if last != newest[name]:  # its unit was another one then
            column += "_in_" + re.sub(r"\W+", "_", str(unit))
        sensors.append(Sensor(str(name), str(unit), column))
    return tuple(sensors)


def sensor_columns(
    stored: Sequence[str | None], sensors: Sequence[Sensor]
) -> dict[str, Sequence[Any]]:
    """Of many rows, as their column `readings` holds them: a column each, and their causes."""
    values: dict[tuple[str, str], list[float | None]] = {
        (sensor.name, sensor.unit): [None] * len(stored) for sensor in sensors
    }
    causes: list[str | None] = [None] * len(stored)
    for place, text in enumerate(stored):
        missing = []
        for name, (value, unit, *cause) in json.loads(text).items() if text else ():
            if (name, unit) in values:
                values[name, unit][place] = value
            if cause:
                missing.append(f"{name}: {cause[0]}")
        if missing:
            causes[place] = "; ".join(missing)
    columns = {sensor.column: values[sensor.name, sensor.unit] for sensor in sensors}
    return {**columns, CAUSES: causes}
