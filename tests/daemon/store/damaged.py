"""A record to be damaged, and how to judge what is left of it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from daemon.errors import DatabaseDamagedError
from daemon.store.database import open_store
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.opening import damage_noted, open_checked_store
from daemon.store.records import GapCause, Mark
from daemon.store.salvage import salvage
from tests.daemon.store.examples import PERIOD_S, START, calibration, datum, full_record, slot

ROWS = 120
BIG = {"method": "rigid", "numbers": list(range(3000))}
"""A calibration that needs several pages."""
EVERYTHING = (
    *("measurement", "gap", "calibration", "calibration_activation", "datum", "ledger"),
    *("event", "mark"),
)

Row = tuple[object, ...]


def rows_of(path: Path) -> dict[str, set[Row]]:
    """Each table's rows, past the program; gaps without the number that they are given again."""
    with closing(sqlite3.connect(path)) as connection:
        found = {table: set(connection.execute(f"SELECT * FROM {table}")) for table in EVERYTHING}
    found["gap"] = {row[1:-1] for row in found["gap"]}
    return found


def make_sound(state: Path) -> None:
    """Make the state of a site with rows of every kind, stopped in order."""
    with open_store(state) as store:
        store.add_calibration(calibration(BIG), activate=True)
        store.add_calibration(calibration(), datum(1.0, 2.0), activate=True)
        for number in range(ROWS):
            store.add_measurement(full_record(slot(number), calibration_id=1 + number // 60))
        for number in range(6):
            first = ROWS + 100 * number
            store.record_gap(slot(first), slot(first + 9), GapCause.CRASH, period_s=PERIOD_S)
        for number in range(40):
            store.add_event(START, "happened", f"number {number}")
        note = LedgerEntry(LedgerKind.EXCLUDE, "eve", START, "paint", slot(3), slot(9))
        store.add_ledger_entry(note)
        store.set_mark(Mark.BOOT_ID, "boot-1")
        store.set_mark(Mark.CLEAN_STOP_UTC, "2026-03-01T02:00:00.000000Z")


def opened_and_read(state: Path) -> None:
    """As the daemon's life: started again, with a note, when it meets damage while it reads."""
    for _ in range(2):
        try:
            with open_checked_store(state) as store, damage_noted(store):
                list(store.measurements())
                store.gaps()
                store.calibrations()
                store.events()
                list(map(store.get_mark, Mark))
        except DatabaseDamagedError:
            continue
        return
    pytest.fail("the damage was not dealt with at the second start")


def wrong(found: dict[str, set[Row]], true: dict[str, set[Row]]) -> int:
    """How many rows say what nobody wrote; that a calibration is lost, and the rest, is said."""
    said = {row for row in found["calibration"] if row[2] == salvage.LOST}
    said |= {row for row in found["event"] if row[2] == "database_salvaged"}
    said |= {row for row in found["mark"] if row[0] in {"salvaged", "schema", "identity"}}
    wrong = {table: found[table] - true[table] - said for table in found}
    # An activation may be given again: its calibration is the one that rows were measured with.
    wrong["calibration_activation"] = {
        row for row in wrong["calibration_activation"] if row[1] != 2
    }
    # Of a gap that was lost in part nothing else may come back.
    return sum(map(len, wrong.values()))
