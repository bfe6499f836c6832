"""Measurements as CSV: the columns of `reprocess` first, then everything else a row knows."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TextIO

from core.results import Measurement
from daemon.durable import fsync_directory, fsync_file, temporary_name
from daemon.store.checksum import DIGEST
from daemon.store.convert import BURST_COLUMNS, RESULT_COLUMNS, measurement_columns
from daemon.store.records import MeasurementRecord
from daemon.store.schema import MeasurementRow
from daemon.times import instant_text, slot_text

EXTRA_COLUMNS = tuple(
    column.name
    for column in MeasurementRow.__table__.columns
    if column.name not in {"id", DIGEST, *RESULT_COLUMNS}
)
"""What `export` adds, in the order of the database."""

SLOTS = {"slot_utc", "redated_from_utc"}


def write_results(
    results: Iterable[tuple[datetime, Measurement]], output: TextIO, *, bursts: bool = False
) -> int:
    """Write slots and what was measured in them, line by line; give the number of rows.

    `bursts` appends the columns of slots with several pairs.
    """
    records = (
        MeasurementRecord(slot_utc, measurement, config_hash="", version="")
        for slot_utc, measurement in results
    )
    return _write(records, RESULT_COLUMNS + (BURST_COLUMNS if bursts else ()), output)


def write_records(records: Iterable[MeasurementRecord], output: TextIO) -> int:
    """Write stored rows with all their columns, line by line; give the number of rows.

    Numbers keep all their digits; what a row does not have is empty.
    """
    return _write(records, RESULT_COLUMNS + EXTRA_COLUMNS, output)


@contextmanager
def opened_output(path: Path | None) -> Iterator[TextIO]:
    """Open a file to write a table to, or stdout for None.

    The file appears, or replaces an older one, complete and durable, or not at all; devices and
    pipes are written to as they are. Raises OSError.
    """
    if path is None:
        yield sys.stdout
        sys.stdout.flush()
    elif path.exists() and not path.is_file():
        with path.open("w", encoding="utf-8", newline="") as file:
            yield file
    else:
        with (
            replacing(path) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            yield file


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a name to write to; the file appears complete and durable, or not at all.

    Raises OSError.
    """
    path = path.resolve()  # a link is followed, not replaced
    temporary = temporary_name(path)
    try:
        temporary.touch()
    except OSError as error:
        error.filename = str(path.parent)  # what stands in the way; nobody knows the other name
        raise
    try:
        yield temporary
        fsync_file(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    fsync_directory(path.parent)


def _write(records: Iterable[MeasurementRecord], columns: tuple[str, ...], output: TextIO) -> int:
    table = csv.writer(output, lineterminator="\n")
    table.writerow(columns)
    count = 0
    for record in records:
        row = measurement_columns(record)
        table.writerow([_cell(name, row.get(name)) for name in columns])
        count += 1
    return count


def _cell(name: str, value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, datetime):
        return slot_text(value) if name in SLOTS else instant_text(value)
    return repr(value) if isinstance(value, float) else str(value)
