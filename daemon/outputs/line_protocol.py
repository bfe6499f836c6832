"""Rows in InfluxDB's line protocol: https://docs.influxdata.com/influxdb/v2/reference/syntax/line-protocol/.

A point is known by measurement, tags and time: the same row sent again replaces itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from datetime import datetime

from daemon.outputs.row_fields import COUNTS, NUMBERS
from daemon.store.queries.arrivals import Arrival
from daemon.store.rows.convert import stored_readings
from daemon.store.rows.targets import TARGET_COLUMNS, target_values, targets_of

Value = float | int | bool | str

_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
"""A line ends at a line end even within quotes, and a tag has no way to write one."""


def lines_of_row(row: Arrival, measurement: str, site: str) -> Iterator[str]:
    """A line for the main target, and one for each further target."""
    unix_s = int(datetime.fromisoformat(row.slot).timestamp())
    yield line(measurement, {"site": site, "point": "main"}, _main_fields(row), unix_s)
    for target in targets_of(row.values["targets"]):
        values = target_values(target)
        fields: dict[str, Value] = {
            "flag": int(target.flag),
            "reasons": "+".join(target.reasons),
            **{
                name: float(values[name])
                for name in TARGET_COLUMNS
                if isinstance(values.get(name), float)
            },
        }
        tags = {"site": site, "point": target.name, "role": str(values["role"])}
        yield line(measurement, tags, fields, unix_s)


def _main_fields(row: Arrival) -> dict[str, Value]:
    values = row.values
    return {
        "flag": int(values["flag"]),
        "reasons": str(values["reasons"]),
        "recorded_late": bool(values["recorded_late"]),
        **{name: float(values[name]) for name in NUMBERS if values[name] is not None},
        **{name: int(values[name]) for name in COUNTS if values[name] is not None},
        **{
            f"reading_{one.name}": float(one.value)
            for one in stored_readings(values["readings"])
            if one.value is not None
        },
    }


def line(
    measurement: str, tags: Mapping[str, str], fields: Mapping[str, Value], unix_s: int
) -> str:
    """One point, its time in seconds; a tag without a value is left out."""
    key = ",".join(
        [
            _escaped(measurement, ", "),
            *(f"{_escaped(name)}={_escaped(tags[name])}" for name in sorted(tags) if tags[name]),
        ]
    )
    content = ",".join(f"{_escaped(name)}={_field(value)}" for name, value in fields.items())
    return f"{key} {content} {unix_s}"


def _escaped(text: str, signs: str = ",= ") -> str:
    r"""A name or a tag's value; one that ends in `\` would escape what follows it."""
    plain = _CONTROL.sub(" ", text)
    if plain.endswith("\\"):
        plain += " "
    return re.sub(f"([{signs}])", r"\\\1", plain)


def _field(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value}i"
    if isinstance(value, float):
        return repr(value)
    quoted = _CONTROL.sub(" ", value).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{quoted}"'
