"""`frames.csv` of one day of the frame archive: a line is the mark that its pair is complete."""

from __future__ import annotations

import csv
import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from daemon.durable import append_durable, fsync_directory, write_durable
from drivers.errors import FrameSetError
from drivers.frameset import (
    BURST,
    COLUMNS,
    TABLE,
    FrameSetRow,
    format_header,
    format_row,
    format_slot,
    read_frame_set,
    write_table,
)

EXTRA_COLUMNS = (
    *("skew_s", "captured_utc"),
    *("exposure_main_us", "exposure_sub_us", "gain_main_db", "gain_sub_db"),
    *("temperature_main_c", "temperature_sub_c", "sha256_main", "sha256_sub"),
    BURST,
)
"""Beyond the standard columns, and those of the readings; empty where not known."""

_SLOT = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
_MAIN = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d)(?:_(\d\d))?_main\.png")
_TAIL_BYTES = 4096
"""Many times the longest line."""


def append_row(directory: Path, row: FrameSetRow) -> None:
    """Add a line durably; rows stay in time order. Raises OSError."""
    path = directory / TABLE
    if not path.exists():
        write_durable(path, f"{format_header(row.extra)}\n{format_row(row)}\n".encode())
        return
    cut_torn_end(path)
    columns, last = _columns_and_last_pair(path)
    known = columns is not None and set(row.extra) <= set(columns)
    if known and last is not None and last < (format_slot(row.slot_utc).encode(), row.burst):
        line = format_row(_with_columns(row, dict.fromkeys(columns or (), "")))
        append_durable(path, line.encode() + b"\n")
    else:
        _rewrite(directory, [row])


def find(directory: Path, slot_utc: datetime, number: int = 1) -> dict[str, str] | None:
    """The cells of a pair's line, None when it has none; other slots' lines are not looked at."""
    try:
        text = (directory / TABLE).read_bytes()
    except FileNotFoundError:
        return None
    mark = b"\n" + format_slot(slot_utc).encode() + b","
    lines = [text[: text.find(b"\n")]]
    start = text.find(mark)
    while start >= 0 and (end := text.find(b"\n", start + 1)) >= 0:
        lines.append(text[start + 1 : end])
        start = text.find(mark, end)
    names, *rows = csv.reader(line.decode("utf-8", "replace") for line in lines)
    for row in rows:
        cells = dict(zip(names, row, strict=False))  # a damaged line is read as far as it goes
        if (cells.get(BURST) or "1") == str(number):
            return cells
    return None


def repair(directory: Path) -> list[datetime]:
    """Bring a day's table in step with its images after a crash; give the slots entered again.

    Leftovers of interrupted writes go. A torn last line is cut. A table that cannot be read is
    set aside, never deleted, and written again from the images. Raises OSError.
    """
    for leftover in directory.glob(".*.tmp"):
        leftover.unlink()
    path = directory / TABLE
    if path.exists():
        cut_torn_end(path)
    return _rewrite(directory, [])


def remove_rows(directory: Path, slot_utc: datetime) -> None:
    """Take a slot's lines out of a day's table, durably. Raises OSError."""
    rows = _readable_rows(directory)
    kept = [row for row in rows if row.slot_utc != slot_utc]
    if len(kept) < len(rows):
        write_table(directory, kept)


def prune(directory: Path) -> int:
    """Strike the lines of which no image is there any more, durably; give how many lines are left.

    Raises OSError.
    """
    names = {path.name for path in directory.iterdir()}
    rows = _readable_rows(directory)
    listed = [row for row in rows if row.main in names or row.sub in names]
    if len(listed) < len(rows) and listed:
        write_table(directory, listed)
    return len(listed)


def cut_torn_end(path: Path) -> None:
    """Cut what a power cut left of a line after the last complete one. Raises OSError."""
    with path.open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        start = max(0, size - _TAIL_BYTES)
        file.seek(start)
        tail = file.read()
        if not tail.endswith(b"\n"):
            file.truncate(start + tail.rfind(b"\n") + 1)
            os.fsync(file.fileno())


def pairs(directory: Path) -> Iterator[tuple[datetime, int]]:
    """Slot and number of each pair of which both images are in a day's directory, in order."""
    year, month, day = (int(part) for part in directory.parts[-3:])
    names = {path.name for path in directory.iterdir()}
    found = []
    for name in names:
        match = _MAIN.fullmatch(name)
        if match and name.replace("_main", "_sub") in names:
            hour, minute, second, number = (int(part or 1) for part in match.groups())
            found.append((datetime(year, month, day, hour, minute, second, tzinfo=UTC), number))
    yield from sorted(set(found))


def image_names(slot_utc: datetime, number: int = 1) -> tuple[str, str]:
    """The file names of a pair: `HHMMSS_main.png`, for a burst's second `HHMMSS_02_main.png`."""
    stem = slot_utc.strftime("%H%M%S") + (f"_{number:02d}" if number > 1 else "")
    return f"{stem}_main.png", f"{stem}_sub.png"


def sha256(data: bytes) -> str:
    """Checksum of a file's content, as the table holds it."""
    return hashlib.sha256(data).hexdigest()


def _columns_and_last_pair(path: Path) -> tuple[list[str] | None, tuple[bytes, int] | None]:
    """The columns beyond the standard ones; slot as text and number of the last line.

    None when only a rewrite can go on from there.
    """
    with path.open("rb") as file:
        header = file.readline()
        columns = header.decode("utf-8", "replace").rstrip("\n").split(",")
        if tuple(columns[: len(COLUMNS)]) != COLUMNS or columns[-1] != BURST:
            return None, None
        file.seek(max(len(header), file.seek(0, os.SEEK_END) - _TAIL_BYTES))
        lines = file.read().splitlines()
    extra = columns[len(COLUMNS) :]
    if not lines:
        return extra, (b"", 0)
    slot, number = lines[-1].partition(b",")[0], lines[-1].rpartition(b",")[2]
    whole = _SLOT.fullmatch(slot) and number.isdigit()
    return extra, (slot, int(number or 1)) if whole else None


def _rewrite(directory: Path, new: Sequence[FrameSetRow]) -> list[datetime]:
    """Add rows, and those of pairs without a line, at their places; give the latter's slots."""
    rows = {(row.slot_utc, row.burst): row for row in _readable_rows(directory)}
    rows |= {(row.slot_utc, row.burst): row for row in new}
    unlisted = [pair for pair in pairs(directory) if pair not in rows]
    rows |= {pair: _row_of_images(directory, *pair) for pair in unlisted}
    if new or unlisted:
        extra = dict.fromkeys(EXTRA_COLUMNS, "")
        for row in rows.values():
            extra |= dict.fromkeys(row.extra, "")
        extra[BURST] = extra.pop(BURST)  # the last one, where the next line looks for it
        write_table(directory, [_with_columns(rows[pair], extra) for pair in sorted(rows)])
    return list(dict.fromkeys(slot for slot, _ in unlisted))


def _readable_rows(directory: Path) -> tuple[FrameSetRow, ...]:
    path = directory / TABLE
    if not path.exists():
        return ()
    try:
        return read_frame_set(directory).rows
    except FrameSetError:
        number = 1
        while (aside := directory / f"{TABLE}.damaged-{number}").exists():
            number += 1
        path.rename(aside)
        fsync_directory(directory)
        return ()


def _row_of_images(directory: Path, slot_utc: datetime, number: int) -> FrameSetRow:
    main, sub = image_names(slot_utc, number)
    extra = {
        BURST: str(number),
        "sha256_main": sha256((directory / main).read_bytes()),
        "sha256_sub": sha256((directory / sub).read_bytes()),
    }
    return FrameSetRow(slot_utc, "measure", main, sub, extra=extra)


def _with_columns(row: FrameSetRow, empty: dict[str, str]) -> FrameSetRow:
    return FrameSetRow(
        row.slot_utc,
        row.role,
        row.main,
        row.sub,
        row.pan_deg,
        row.tilt_deg,
        extra=empty | dict(row.extra) | {BURST: str(row.burst)},
    )
