"""How commands talk: data on stdout, diagnostics on stderr, drawn tables on a terminal only."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from daemon.store.json_fields import plain
from daemon.store.records import GapRecord

if TYPE_CHECKING:
    from rich.progress import Progress

JSON_SCHEMA = 1


def say(text: str = "") -> None:
    """Print a line of data."""
    print(text)


def note(text: str) -> None:
    """Print a diagnostic line on stderr."""
    print(f"dcam-ctl: {text}", file=sys.stderr)


def print_json(payload: Mapping[str, Any]) -> None:
    """Print one JSON object with its schema number; times in ISO 8601, never NaN."""
    document = plain({"schema": JSON_SCHEMA, **payload})
    print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))


def gap_fields(gap: GapRecord) -> dict[str, object]:
    """A gap for `--json`."""
    return {
        "start_utc": gap.first_slot_utc,
        "end_utc": gap.last_slot_utc,
        "slots": gap.slots,
        "period_s": gap.period_s,
        "cause": gap.cause,
        "detail": gap.detail,
    }


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table: drawn on a terminal, else plain columns two spaces apart."""
    if sys.stdout.isatty():
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

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

    def begin(self, what: str) -> None:
        """Another piece of work begins, of a size that is not known yet."""
        self._progress.reset(self._task, description=what)

    def at(self, done: int, total: int) -> None:
        """So many of so many are done: for work whose size shows on the way."""
        self._progress.update(self._task, completed=done, total=total)


@contextmanager
def progress(total: int, what: str) -> Iterator[Steps]:
    """Show a progress bar on stderr while the block runs, if stderr is a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

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
