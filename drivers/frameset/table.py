"""The table of a frame set: read and checked line by line, written as a whole."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Protocol, cast, get_args

from drivers.errors import FrameSetError
from drivers.frameset.row import (
    BURST,
    COLUMNS,
    HEADER,
    READING_COLUMN,
    TABLE,
    TEMPERATURES,
    FrameRole,
    FrameSetRow,
    format_header,
    format_row,
    format_slot,
    optional_number,
    parse_slot,
)


class FramePath(Protocol):
    """A directory or a file of a frame set: a `Path`, or another thing with this much of it."""

    @property
    def name(self) -> str:
        """The last part."""

    def read_bytes(self) -> bytes:
        """The file's content. Raises FileNotFoundError, OSError."""

    def __truediv__(self, name: str) -> FramePath:
        """What lies in it under this name."""


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
                msg = f"{where}: {len(cells)} fields, the header has {len(columns)}; fix the line"
                raise FrameSetError(msg)
            cell = dict(zip(columns, (text.strip() for text in cells), strict=True))
            try:
                yield lines.line_num, _row(cell)
            except ValueError as error:
                msg = f"{where}: {error}"
                raise FrameSetError(msg) from None
    except csv.Error as error:
        msg = f"{path}:{lines.line_num}: not a CSV line ({error}); fix the line"
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
    return column in TEMPERATURES.values() or READING_COLUMN.fullmatch(column) is not None


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
