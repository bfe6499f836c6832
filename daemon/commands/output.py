"""How commands talk: data on stdout, diagnostics on stderr, drawn tables on a terminal only."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from core.results import Flag, Measurement
from daemon.export import RESULT_COLUMNS
from daemon.store.convert import measurement_row
from daemon.store.records import MeasurementRecord

JSON_SCHEMA = 1


def say(text: str = "") -> None:
    """Print a line of data."""
    print(text)


def note(text: str) -> None:
    """Print a diagnostic line on stderr."""
    print(f"dcam-ctl: {text}", file=sys.stderr)


def print_json(payload: Mapping[str, Any]) -> None:
    """Print one JSON object with its schema number; times in ISO 8601, never NaN."""
    document = _plain({"schema": JSON_SCHEMA, **payload})
    print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
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
    row = measurement_row(MeasurementRecord(slot_utc, measurement, config_hash="", version=""))
    fields = {name: getattr(row, name) for name in RESULT_COLUMNS}
    return {**fields, "reasons": [reason.value for reason in measurement.reasons]}


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table: drawn on a terminal, else plain columns two spaces apart."""
    if sys.stdout.isatty():
        table = Table(*columns, header_style="bold")
        for row in rows:
            table.add_row(*(Text(cell) for cell in row))
        Console().print(table)
        return
    lines = [columns, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    for line in lines:
        cells = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        print("  ".join(cells).rstrip())


class Steps:
    """Tells how far a long work has come; the bar is seen on a terminal only."""

    def __init__(self, progress: Progress, total: int, what: str) -> None:
        self._progress = progress
        self._task = progress.add_task(what, total=total)

    def next(self, what: str | None = None) -> None:
        """One step is done; `what` is being done now."""
        if what is not None:
            self._progress.update(self._task, description=what)
        self._progress.advance(self._task)


@contextmanager
def progress(total: int, what: str) -> Iterator[Steps]:
    """Show a progress bar on stderr while the block runs, if stderr is a terminal."""
    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        yield Steps(bar, total, what)


def utc_text(when: datetime) -> str:
    """Write a time as `2026-03-01T00:00:00Z`; fractions of a second only if there are any."""
    return when.astimezone(UTC).isoformat().replace("+00:00", "Z")


def span_text(seconds: float) -> str:
    """Write a duration with its two leading units: `42 s`, `3 min 5 s`, `2 d 4 h`."""
    left = round(abs(seconds))
    parts = []
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        count, left = divmod(left, size)
        if count:
            parts.append(f"{count} {unit}")
        elif parts:
            break
    return " ".join(parts[:2]) or "0 s"


def value_text(measurement: Measurement) -> str:
    """Write a displacement, or why there is none, in a few words."""
    why = "+".join(measurement.reasons)
    if measurement.corrected is None:
        return f"no value ({measurement.flag.name.lower()}: {why})"
    (x_mm, y_mm), covariance = measurement.corrected.mm, measurement.corrected.covariance_mm2
    text = (
        f"x {x_mm:+.3f} ± {covariance[0, 0] ** 0.5:.3f} mm, "
        f"y {y_mm:+.3f} ± {covariance[1, 1] ** 0.5:.3f} mm"
    )
    return text if measurement.flag is Flag.GOOD else f"{text} (suspect: {why})"


def bytes_text(count: float) -> str:
    """Write a number of bytes in decimal units, as disks are sold."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
