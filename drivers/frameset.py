"""Frame sets: a directory of lossless greyscale PNG images and their table, `frames.csv`.

Whatever is damaged in one gives a `FrameSetError` of one line: what, where, what to do.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Literal, Protocol, cast, get_args

from core.images import GreyImage
from drivers.errors import FrameSetError, ImageMissingError
from drivers.png import decode_png, encode_png
from drivers.protocols import Role

__all__ = [
    "COLUMNS",
    "HEADER",
    "READING",
    "TABLE",
    "TEMPERATURES",
    "FramePath",
    "FrameRole",
    "FrameSet",
    "FrameSetRow",
    "encode_png",
    "format_header",
    "format_row",
    "format_slot",
    "optional_number",
    "parse_slot",
    "read_frame_set",
    "read_image",
    "read_table",
    "readings_of",
    "slots_of_rows",
    "write_table",
]

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

_READING_COLUMN = re.compile(rf"{READING}([a-z0-9-]{{1,32}})")
_NO_EXTRA: Mapping[str, str] = MappingProxyType({})


class FramePath(Protocol):
    """A directory or a file of a frame set: a `Path`, or another thing with this much of it."""

    @property
    def name(self) -> str:
        """The last part."""

    def read_bytes(self) -> bytes:
        """The file's content. Raises FileNotFoundError, OSError."""

    def __truediv__(self, name: str) -> FramePath:
        """What lies in it under this name."""


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


@dataclass(frozen=True, slots=True)
class FrameSet:
    """A frame set as its table describes it; the images are read one by one."""

    directory: Path
    rows: tuple[FrameSetRow, ...]

    def rows_of(self, *roles: FrameRole) -> tuple[FrameSetRow, ...]:
        """Give the rows of these roles, in time order."""
        return tuple(row for row in self.rows if row.role in roles)

    def slots_of(self, *roles: FrameRole) -> tuple[tuple[FrameSetRow, ...], ...]:
        """Give the rows of these roles, those of one slot together, in time order."""
        return tuple(slots_of_rows(self.rows_of(*roles)))

    def read(self, name: str) -> GreyImage:
        """Read one image by its name in the table. Raises FrameSetError."""
        return read_image(self.directory / name)


# ---------------------------------------------------------------------------------- the table


def read_frame_set(directory: Path) -> FrameSet:
    """Read a set's table and check it; missing images are found when they are read.

    Raises FrameSetError: no table, missing column, bad time, unknown role, duplicate slot, two
    references, rows out of order ...; the message names file and line.
    """
    if not directory.is_dir():
        msg = f"{directory}: no such directory; give the directory of a frame set"
        raise FrameSetError(msg)
    return FrameSet(directory, read_table(directory))


def read_table(directory: FramePath) -> tuple[FrameSetRow, ...]:
    """Read and check the table in a directory, wherever it is. Raises FrameSetError."""
    path = directory / TABLE
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        msg = f"{path}: not there; a frame set needs a table with the columns {HEADER}"
        raise FrameSetError(msg) from None
    except UnicodeDecodeError as error:
        msg = f"{path}: not UTF-8 text at byte {error.start}; restore the file"
        raise FrameSetError(msg) from None
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror}); check the file and its permissions"
        raise FrameSetError(msg) from None
    return tuple(_checked(path, _parse(path, text)))


def slots_of_rows(rows: Iterable[FrameSetRow]) -> Iterator[tuple[FrameSetRow, ...]]:
    """Give the rows of one slot together, in the order of the rows."""
    for _, same in groupby(rows, key=lambda row: row.slot_utc):
        yield tuple(same)


def _parse(path: FramePath, text: str) -> Iterator[tuple[int, FrameSetRow]]:
    """Give the rows with their line numbers."""
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = next(lines, None)
        columns = _columns(path, header)
        for cells in lines:
            if not cells:
                continue
            where = f"{path}:{lines.line_num}"
            if len(cells) != len(columns):
                msg = f"{where}: {len(cells)} fields, the header has {len(columns)}; mend the line"
                raise FrameSetError(msg)
            cell = dict(zip(columns, (text.strip() for text in cells), strict=True))
            try:
                yield lines.line_num, _row(cell)
            except ValueError as error:
                msg = f"{where}: {error}"
                raise FrameSetError(msg) from None
    except csv.Error as error:
        msg = f"{path}:{lines.line_num}: not a CSV line ({error}); mend the line"
        raise FrameSetError(msg) from None


def _columns(path: FramePath, header: list[str] | None) -> list[str]:
    if not header:
        msg = f"{path}: empty; the first line must name the columns {HEADER}"
        raise FrameSetError(msg)
    columns = [name.strip() for name in header]
    for name in COLUMNS:
        if columns.count(name) != 1:
            fault = "missing" if name not in columns else "given twice"
            msg = f"{path}:1: column {name!r} is {fault}; the columns are {HEADER}"
            raise FrameSetError(msg)
    for name in columns:
        if (name == BURST or _is_number(name)) and columns.count(name) > 1:
            msg = f"{path}:1: column {name!r} is given twice; keep one"
            raise FrameSetError(msg)
    return columns


def _is_number(column: str) -> bool:
    """Whether an optional column holds numbers that are read as such."""
    return column in TEMPERATURES.values() or _READING_COLUMN.fullmatch(column) is not None


def _row(cell: dict[str, str]) -> FrameSetRow:
    """Convert the text of one line. Raises ValueError: what is wrong and what to do."""
    role = cell["role"]
    if role not in get_args(FrameRole):
        msg = f"unknown role {role!r}; use one of {', '.join(get_args(FrameRole))}"
        raise ValueError(msg)
    sub = _file_name(cell["sub"], "sub")
    if sub is None and role != "measure":
        msg = f"column 'sub' is empty; a row of role {role} needs a sub-camera image"
        raise ValueError(msg)
    number = cell.get(BURST, "")
    if number and not (number.isdecimal() and int(number) >= 1):
        msg = f"bad number {number!r} in column {BURST!r}; number the pairs of a slot from 1"
        raise ValueError(msg)
    for column, text in cell.items():
        if _is_number(column) and text and optional_number(text) is None:
            msg = f"bad number {text!r} in column {column!r}; write a number or leave it empty"
            raise ValueError(msg)
    return FrameSetRow(
        slot_utc=parse_slot(cell["slot_utc"]),
        role=cast("FrameRole", role),
        main=_file_name(cell["main"], "main"),
        sub=sub,
        pan_deg=_angle(cell["pan_deg"], "pan_deg"),
        tilt_deg=_angle(cell["tilt_deg"], "tilt_deg"),
        extra=MappingProxyType({k: v for k, v in cell.items() if k not in COLUMNS}),
    )


def _checked(path: FramePath, rows: Iterable[tuple[int, FrameSetRow]]) -> Iterator[FrameSetRow]:
    """Pass rows on while slots are unique and in order and there is one reference at most.

    Rows of one slot are one burst: their numbers rise, and they have one role.
    """
    line_of: dict[datetime, int] = {}
    last: FrameSetRow | None = None
    reference: int | None = None
    for line, row in rows:
        slot = format_slot(row.slot_utc)
        follows = last is not None and last.slot_utc == row.slot_utc and row.burst > last.burst
        if row.slot_utc in line_of and not follows:
            msg = f"{path}:{line}: slot {slot} is already on line {line_of[row.slot_utc]}; drop one"
            if BURST in row.extra:
                msg += f", or number the pairs of the slot in column {BURST!r}, rising from 1"
            raise FrameSetError(msg)
        if last is not None and row.slot_utc < last.slot_utc:
            msg = f"{path}:{line}: slot {slot} is before the row above; put rows in time order"
            raise FrameSetError(msg)
        if last is not None and follows and row.role != last.role:
            msg = (
                f"{path}:{line}: role {row.role}, but slot {slot} began as {last.role}; "
                "give all pairs of a burst one role"
            )
            raise FrameSetError(msg)
        if row.role == "reference" and not follows:
            if reference is not None:
                msg = (
                    f"{path}:{line}: second reference, the first is on line {reference}; "
                    "keep one and make the other a 'rig' row"
                )
                raise FrameSetError(msg)
            reference = line
        line_of[row.slot_utc] = line
        last = row
        yield row


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


def _file_name(text: str, column: str) -> str | None:
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or "\0" in text:
        msg = f"file name {text!r} in column {column!r} leads out of the set; name a file within it"
        raise ValueError(msg)
    return text or None


def _angle(text: str, column: str) -> float | None:
    if not text:
        return None
    try:
        angle_deg = float(text)
    except ValueError:
        angle_deg = math.nan
    if not math.isfinite(angle_deg):
        msg = f"bad angle {text!r} in column {column!r}; write degrees or leave it empty"
        raise ValueError(msg)
    return angle_deg


def optional_number(text: str | None) -> float | None:
    """A finite number; None for an empty cell, and for a damaged one."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def readings_of(cells: Mapping[str, str]) -> dict[str, float]:
    """The sensors' readings in a line's cells, by name; those without a value are left out."""
    named = ((_READING_COLUMN.fullmatch(column), text) for column, text in cells.items())
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


def write_table(directory: Path, rows: Iterable[FrameSetRow]) -> None:
    """Write a whole `frames.csv`, replacing any old one in a single step, durably.

    An extra column that a row does not have is empty in its line.
    """
    rows = list(rows)
    extra = list(dict.fromkeys(name for row in rows for name in row.extra))
    lines = [format_header(extra), *(format_row(row, extra) for row in rows)]
    temporary = directory / f".{TABLE}.tmp"
    try:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            file.write("\n".join(lines) + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(directory / TABLE)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# ---------------------------------------------------------------------------------- the images


def read_image(path: FramePath) -> GreyImage:
    """Read an 8- or 16-bit greyscale PNG, whole and undamaged or not at all.

    Raises FrameSetError (ImageMissingError when the file is not there).
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        msg = f"{path}: not there; restore the image or drop its row from {TABLE}"
        raise ImageMissingError(msg) from None
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror}); check the file and its permissions"
        raise FrameSetError(msg) from None
    try:
        return decode_png(data)
    except ValueError as error:
        msg = f"{path}: {error}"
        raise FrameSetError(msg) from None
