"""One row of a frame set's table, and how it is written."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import groupby
from types import MappingProxyType
from typing import Literal

from drivers.protocols import Role

FrameRole = Literal["intrinsics", "reference", "rig", "measure"]

TABLE = "frames.csv"
COLUMNS = ("slot_utc", "role", "main", "sub", "pan_deg", "tilt_deg")
HEADER = ",".join(COLUMNS)
"""First line of a plain `frames.csv`, without its line end."""
BURST = "burst"
"""Optional column that numbers the pairs of one slot from 1; empty is 1."""
TEMPERATURES: Mapping[Role, str] = MappingProxyType(
    {"main": "temperature_main_c", "sub": "temperature_sub_c"}
)
"""Optional columns of what the cameras say of their own temperatures."""
READING = "reading_"
"""What the optional column of a sensor's reading begins with; its name follows."""

READING_COLUMN = re.compile(rf"{READING}([a-z0-9-]{{1,32}})")
_NO_EXTRA: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class FrameSetRow:
    """One row of `frames.csv`: a frame pair, or a lens view."""

    slot_utc: datetime
    """Timezone-aware UTC, whole seconds."""
    role: FrameRole
    main: str | None
    """File name within the set."""
    sub: str | None
    pan_deg: float | None = None
    tilt_deg: float | None = None
    extra: Mapping[str, str] = field(default_factory=lambda: _NO_EXTRA)
    """Columns beyond the standard ones, as text, in the table's order."""

    @property
    def burst(self) -> int:
        """The number of this pair within its slot."""
        return int(self.extra.get(BURST) or 1)

    @property
    def main_temperature_c(self) -> float | None:
        """What the main camera said of its temperature; None where that is not known."""
        return optional_number(self.extra.get(TEMPERATURES["main"]))

    @property
    def sub_temperature_c(self) -> float | None:
        """What the sub-camera said of its temperature."""
        return optional_number(self.extra.get(TEMPERATURES["sub"]))

    @property
    def readings(self) -> Mapping[str, float]:
        """The sensors' readings by name, in the table's order; those without a value are left out.

        Their units stand in the config.
        """
        return readings_of(self.extra)


def slots_of_rows(rows: Iterable[FrameSetRow]) -> Iterator[tuple[FrameSetRow, ...]]:
    """Give the rows of one slot together, in the order of the rows."""
    for _, same in groupby(rows, key=lambda row: row.slot_utc):
        yield tuple(same)


def parse_slot(text: str) -> datetime:
    """Read a slot such as `2026-03-01T00:00:00Z`. Raises ValueError: what is wrong."""
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        when = None
    if when is None or when.utcoffset() != timedelta(0) or when.microsecond:
        msg = (
            f"bad time {text!r} in column 'slot_utc'; "
            "write UTC to whole seconds, e.g. 2026-03-01T00:00:00Z"
        )
        raise ValueError(msg)
    return when.astimezone(UTC)


def format_slot(slot_utc: datetime) -> str:
    """Write a slot as `2026-03-01T00:00:00Z`."""
    return slot_utc.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def optional_number(text: str | None) -> float | None:
    """A finite number; None for an empty cell, and for a damaged one."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def readings_of(cells: Mapping[str, str]) -> dict[str, float]:
    """The sensors' readings in a line's cells, by name; those without a value are left out."""
    named = ((READING_COLUMN.fullmatch(column), text) for column, text in cells.items())
    found = {match[1]: optional_number(text) for match, text in named if match is not None}
    return {name: value for name, value in found.items() if value is not None}


def format_row(row: FrameSetRow, extra_columns: Iterable[str] | None = None) -> str:
    """Write one line of `frames.csv`, without its line end: `COLUMNS`, then the extra values.

    These are all that the row has, or those of the columns given, empty where it has none.
    """
    cells = [format_slot(row.slot_utc), row.role, row.main or "", row.sub or ""]
    cells += ["" if angle is None else repr(angle) for angle in (row.pan_deg, row.tilt_deg)]
    names = row.extra if extra_columns is None else extra_columns
    return _csv_line([*cells, *(row.extra.get(name, "") for name in names)])


def format_header(extra_columns: Iterable[str] = ()) -> str:
    """Write the header line, without its line end, of a table with extra columns."""
    return _csv_line([*COLUMNS, *extra_columns])


def _csv_line(cells: Iterable[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()
