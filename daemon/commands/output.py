"""How commands talk: data on stdout, diagnostics on stderr, one shape on a terminal and a pipe."""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, tzinfo
from typing import TYPE_CHECKING, Any, Protocol

import click

from daemon.plain import plain
from daemon.text import visible
from daemon.zones import in_zone

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from daemon.store.records import GapRecord

JSON_SCHEMA = 1
LINE_PERIOD_S = 10.0
"""How often a long work says on a pipe how far it has come."""
PAGE = 80
"""Columns of what people read line by line, on a pipe too; fewer on a narrower terminal."""
_MORE = " ..."
_GAP = 2
"""Spaces between two columns."""
_NARROWEST = 12
"""Columns of a terminal below which a text column is no longer worth reading."""
_NO_LIMIT = 100_000
"""Width of a pipe: a row is one line, whatever it holds."""


ZONE = "daemon.zone"
"""Where a command's context keeps the zone in which people read times."""


def shown_zone() -> tzinfo:
    """The zone in which the command that runs shows times to people; UTC unless it has `--tz`."""
    context = click.get_current_context(silent=True)
    zone: tzinfo = context.meta.get(ZONE, UTC) if context else UTC
    return zone


def _readable(text: str) -> str:
    return visible(in_zone(text, shown_zone()))


def say(text: str = "", *, now: bool = False) -> None:
    """Print a line of data; times in the zone of `--tz`.

    Now: a pipe, too, has it at once, as a command that goes on for long wants it.
    """
    print(_readable(text), flush=now)


def page_columns() -> int:
    """How wide a line for people may be."""
    return min(PAGE, shutil.get_terminal_size().columns) if sys.stdout.isatty() else PAGE


def hanging(words: Sequence[str], widths: Sequence[int], text: str, colour: str = "") -> list[str]:
    """Lay out words in columns so wide and the text behind them, wrapped at page_columns().

    A first word that is too long has lines of its own. The last word is in colour on a terminal.
    """
    page, indent = page_columns(), sum(widths)
    body = wrapped(_readable(text), max(page - indent, _NARROWEST)) or [""]
    above = [] if len(words[0]) < widths[0] else wrapped(_readable(words[0]), page)
    cells = ["" if above else words[0], *words[1:]]
    padded = [f"{cell:<{columns}}" for cell, columns in zip(cells, widths, strict=True)]
    if colour and padded[-1].strip() and _in_colour():
        padded[-1] = click.style(padded[-1], fg=colour, bold=True)
    lines = [*above, "".join(padded) + body[0], *(" " * indent + line for line in body[1:])]
    return [line.rstrip() for line in lines]


def for_terminal(text: str) -> list[str]:
    """Give a line whole on a pipe, where a program reads it; wrapped on a terminal."""
    return wrapped(_readable(text), page_columns()) if sys.stdout.isatty() else [_readable(text)]


def one_line(text: str) -> str:
    """Cut a text at page_columns(); dots say that there is more."""
    lines = wrapped(_readable(text), page_columns())
    if len(lines) == 1:
        return lines[0]
    return wrapped(_readable(text), page_columns() - len(_MORE))[0] + _MORE


def _in_colour() -> bool:
    plain_terminal = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return sys.stdout.isatty() and not plain_terminal


def wrapped(text: str, width: int) -> list[str]:
    """A text in lines of so many columns, with the letters that stdout has: some are wider."""
    from rich.console import Console
    from rich.text import Text

    encoding, errors = sys.stdout.encoding, sys.stdout.errors or "strict"
    written = text.encode(encoding, errors).decode(encoding, "replace")
    lines = Text(written, overflow="fold").wrap(Console(width=width), width)
    return [line.plain.rstrip() for line in lines]


def note(text: str) -> None:
    """Print a diagnostic line on stderr."""
    sys.stderr.write(
        f"dcam-ctl: {_readable(text)}\n"
    )  # at once: progress writes from a thread of its own


def print_json(payload: Mapping[str, Any]) -> None:
    """Print one JSON object with its schema number; times in ISO 8601, never NaN."""
    document = plain({"schema": JSON_SCHEMA, **payload})
    escaped = "utf" not in sys.stdout.encoding.lower()  # a replacement would change the data
    print(visible(json.dumps(document, indent=2, ensure_ascii=escaped, allow_nan=False)))


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
    """Print a table, times in the zone of `--tz`; on a pipe a row is one line.

    On a terminal the widest column is wrapped at spaces; where that leaves it too little, each row
    is a block of lines, `name  value`. Nothing is cut off.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    on_terminal = sys.stdout.isatty()
    size = shutil.get_terminal_size() if on_terminal else os.terminal_size((_NO_LIMIT, 1))
    width = size.columns
    forced = None if on_terminal else False
    console = Console(width=width, height=size.lines, force_terminal=forced, highlight=False)
    lines = [[_readable(" ".join(cell.splitlines())) for cell in line] for line in (columns, *rows)]
    names, cells = lines[0], lines[1:]
    widest = _widest_column(lines)
    with console.capture() as captured:
        if _fits(lines, widest, width):
            table = Table(box=None, padding=(0, _GAP, 0, 0), pad_edge=False, header_style="bold")
            for at, name in enumerate(names):
                table.add_column(Text(name), no_wrap=at != widest, overflow="fold")
            for line in cells:
                table.add_row(*map(Text, line))
            console.print(table)
        else:
            for number, line in enumerate(cells):
                block = Table.grid(padding=(0, _GAP, 0, 0), pad_edge=False)
                block.add_column(style="bold", no_wrap=True)
                block.add_column(overflow="fold")
                for name, cell in zip(names, line, strict=True):
                    block.add_row(Text(name), Text(cell))
                if number:
                    console.print()
                console.print(block)
    for drawn in captured.get().splitlines():
        print(drawn.rstrip())


def _widest_column(lines: Sequence[Sequence[str]]) -> int:
    """Number of the column that is wrapped: the widest, of equal ones the last."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return max(range(len(widths)), key=lambda at: (widths[at], at))


def _fits(lines: Sequence[Sequence[str]], wrapped: int, width: int) -> bool:
    """Whether the wrapped column keeps room for its longest word when the others are whole."""
    from rich.cells import cell_len

    columns = list(zip(*lines, strict=True))
    whole = [max(map(cell_len, column)) for column in columns]
    others = sum(whole) - whole[wrapped] + _GAP * (len(whole) - 1)
    word = max(cell_len(word) for cell in columns[wrapped] for word in cell.split() or [""])
    return width - others >= min(whole[wrapped], max(word, _NARROWEST))


class Steps(Protocol):
    """Takes note of how far a long work has come."""

    def next(self, what: str | None = None) -> None:
        """One step is done; `what` is being done now."""

    def begin(self, what: str) -> None:
        """Another piece of work begins, of a size that is not known yet."""

    def at(self, done: int, total: int | None) -> None:
        """So many of so many are done; None: of an unknown number."""


@contextmanager
def progress(total: int | None, what: str, *, each: bool = False) -> Iterator[Steps]:
    """Tell on stderr how far the block has come: a bar on a terminal, else a line now and then.

    Without a terminal a line is written every LINE_PERIOD_S, so that short work is silent; `each`
    also writes one for each step that has a name.
    """
    if sys.stderr.isatty():
        with _bar(total, what) as steps:
            yield steps
        return
    lines = _Lines(total, what, each=each)
    ended = threading.Event()

    def tell_now_and_then() -> None:
        while not ended.wait(LINE_PERIOD_S):
            lines.tell()

    teller = threading.Thread(target=tell_now_and_then, name="progress", daemon=True)
    teller.start()
    try:
        yield lines
    finally:
        ended.set()
        teller.join()


class _Lines:
    """How far a work has come, in lines of their own: for pipes, logs and cron."""

    def __init__(self, total: int | None, what: str, *, each: bool) -> None:
        self._each = each
        self._start(what, total)

    def _start(self, what: str, total: int | None) -> None:
        self._work, self._step, self._begun_s = what, "", time.monotonic()
        self._done, self._total = 0, total

    def next(self, what: str | None = None) -> None:
        self._done += 1
        if what is not None:
            self._step = what
            if self._each:
                self.tell()

    def begin(self, what: str) -> None:
        self._start(what, None)

    def at(self, done: int, total: int | None) -> None:
        self._done, self._total = done, total

    def tell(self) -> None:
        """Write a line; of work in which nothing is counted, how long it has taken."""
        if self._total is None and not self._done:
            note(f"{self._work}, {time.monotonic() - self._begun_s:.0f} s so far")
            return
        size = "" if self._total is None else f" of {self._total}"
        step = f": {self._step}" if self._step else ""
        note(f"{self._work}, {self._done}{size}{step}")


@contextmanager
def _bar(total: int | None, what: str) -> Iterator[Steps]:
    """Draw a bar that is gone when the block ends."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    # Data on stdout stay there: rich would lead them to the bar's own stream.
    with Progress(*columns, console=console, transient=True, redirect_stdout=False) as bar:
        yield _Bar(bar, bar.add_task(what, total=total))


class _Bar:
    """A bar on a terminal."""

    def __init__(self, bar: Progress, task: TaskID) -> None:
        self._bar, self._task = bar, task

    def next(self, what: str | None = None) -> None:
        if what is not None:
            self._bar.update(self._task, description=what)
        self._bar.advance(self._task)

    def begin(self, what: str) -> None:
        self._bar.remove_task(self._task)  # reset would keep its size
        self._task = self._bar.add_task(what, total=None)

    def at(self, done: int, total: int | None) -> None:
        self._bar.update(self._task, completed=done, total=total)
