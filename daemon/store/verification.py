"""Everything in the database read once: pages, rows, references, calibrations, slots.

Read-only and in small transactions, beside a running daemon. What SQLite itself looks at (pages and
indexes) is one long look, which keeps no writer waiting.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from core.calibration.calibrate import Calibration
from core.errors import CoreError
from daemon.errors import DamagedRowError
from daemon.store.accounting import ScheduleEpoch, audit_slots, scheduled
from daemon.store.queries.overview import Overview
from daemon.store.runs import slot_at
from daemon.store.salvage.damage import program_tables, wrong_rows
from daemon.store.salvage.salvage import LOST
from daemon.store.sqlite import any_text, connect_readonly, is_damage, said_plainly
from daemon.text import count_of
from daemon.times import slot_text

SALVAGE = "restart dcamd: it sets the file aside and saves all else"
REPORT = "nothing mends this by itself: please report it, with the log of that time"
MOST_PAGE_FINDINGS = 20

Tell = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as it should be."""

    what: str
    """A word: database, row, reference, calibration, slots, frame, table, set aside."""
    where: str
    text: str
    todo: str
    is_damage: bool = False
    """The next start of dcamd should look at everything."""


@dataclass(slots=True)
class Counted:
    """What was looked at."""

    rows: int = 0
    slots: int = 0
    images: int = 0
    slots_with_frames_removed: int = 0
    """On purpose, to make room."""


def page_findings(path: Path) -> Iterator[Finding]:
    """Let SQLite look at all pages and indexes. Raises StoreError."""
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        query = f"PRAGMA integrity_check({MOST_PAGE_FINDINGS})"
        try:
            lines = [str(line) for (line,) in connection.execute(query)]
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            lines = [str(error)]
    for line in lines:
        if line != "ok":
            yield Finding("database", path.name, " ".join(line.split()), SALVAGE, is_damage=True)


def row_findings(
    path: Path, since_utc: datetime | None, counted: Counted, tell: Tell
) -> Iterator[Finding]:
    """Check every row, of measurements those of slots from `since_utc` on. Raises StoreError."""
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.text_factory = any_text
        tables = program_tables(connection)
        first = dict.fromkeys(tables, 0)
        if since_utc is not None:
            query = "SELECT min(rowid) - 1 FROM measurement WHERE slot_utc >= ?"
            since = slot_text(since_utc.replace(microsecond=0))
            first["measurement"] = connection.execute(query, (since,)).fetchone()[0] or 0
        total = sum(_rows(connection, table) - first[table] for table in tables)

        def read(count: int) -> None:
            counted.rows += count
            tell(counted.rows, total)

        for table in tables:
            try:
                for text in wrong_rows(connection, table, first[table], read):
                    yield Finding("row", path.name, text, SALVAGE, is_damage=True)
            except sqlite3.DatabaseError as error:
                if not is_damage(error):
                    raise
                text = f"not all rows of {table} can be read ({error})"
                yield Finding("row", path.name, text, SALVAGE, is_damage=True)


def reference_findings(path: Path) -> Iterator[Finding]:
    """Rows that name what is not there, and calibrations that cannot be used. Raises StoreError."""
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.text_factory = any_text
        lost = connection.execute(
            "SELECT calibration_id, count(*), min(slot_utc) FROM measurement"
            " WHERE calibration_id IS NOT NULL"
            " AND calibration_id NOT IN (SELECT id FROM calibration) GROUP BY calibration_id"
        )
        for number, count, first in lost.fetchall():
            rows = count_of(count, "row")
            text = f"calibration {number} is not there, but is that of {rows} from {first} on"
            yield Finding("reference", path.name, text, REPORT)
        for number, method, content in connection.execute(
            "SELECT id, method, content FROM calibration"
        ):
            why = None if method == LOST else _unusable(content)
            if why is not None:
                todo = "calibrate again, from its frames if they were kept (calibrate --from)"
                yield Finding("calibration", f"calibration {number}", why, todo)


def _unusable(content: str) -> str | None:
    try:
        Calibration.from_dict(json.loads(content))
    except (CoreError, ValueError) as error:
        return str(error)
    return None


def slot_findings(
    path: Path,
    epochs: Sequence[ScheduleEpoch],
    since_utc: datetime | None,
    counted: Counted,
    tell: Tell,
) -> Iterator[Finding]:
    """Look whether each slot since the first has exactly one row or gap. Raises StoreError."""
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        accounted = Overview(connection).accounted()
        if accounted is None:
            return
        first_utc = max(accounted[0], since_utc) if since_utc else accounted[0]
        stretches = list(scheduled(list(epochs), first_utc, accounted[1]))
        total = sum(map(len, stretches))
        for slots in stretches:
            try:
                for fate in audit_slots(connection, slots):
                    counted.slots += len(fate.slots)
                    tell(counted.slots, total)
                    for hole in fate.missing_slots:
                        yield Finding("slots", _span(hole), "neither row nor gap", REPORT)
                    for slot in fate.doubled:
                        text = "accounted for twice: a row and a gap, or two gaps"
                        yield Finding("slots", slot_text(slot_at(slot)), text, REPORT)
            except DamagedRowError as error:
                yield Finding("row", path.name, str(error), SALVAGE, is_damage=True)


def _span(slots: range) -> str:
    first, last = (slot_text(slot_at(end)) for end in (slots[0], slots[-1]))
    return first if len(slots) == 1 else f"{first} to {last} ({len(slots)} slots)"


def _rows(connection: sqlite3.Connection, table: str) -> int:
    (newest,) = connection.execute(f"SELECT max(rowid) FROM {table}").fetchone()  # noqa: S608
    return newest or 0
