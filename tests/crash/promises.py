"""What a daemon has promised by a moment, and whether what a disk has kept lets it be kept."""

from __future__ import annotations

import csv
import hashlib
import json
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from daemon.store.damage_note import SET_ASIDE
from daemon.store.sqlite import FILE_NAME
from tests.crash.station import PERIOD_S, daemon, heard

Row = tuple[Any, ...]
STEP = timedelta(seconds=PERIOD_S)
AFTER = "boot-after"
"""The run of the machine after the cut."""


@dataclass(frozen=True, slots=True)
class Promises:
    """What has been reported so far, and must never be otherwise again."""

    first_slot_utc: datetime | None = None
    """From here on every slot is accounted for."""
    rows: frozenset[datetime] = frozenset()
    """Acknowledged."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """The frames of these rows."""
    pictures: frozenset[bytes] = frozenset()
    """Frames of rows whose slots may still change."""
    gaps: Mapping[datetime, str] = field(default_factory=dict)
    """Cause of each slot that has been reported to be missed."""
    events: frozenset[Row] = frozenset()
    """Kind and detail."""
    calibration_id: int = 0
    """The one in use, 0 without."""
    absence: frozenset[str] = frozenset({"power_loss"})
    """What a gap from now on may truly be put down to."""
    damaged: bool = False
    """The database was damaged by more than a cut."""
    backups: Mapping[str, frozenset[datetime]] = field(default_factory=dict)
    """Slots in each copy of the database."""


@dataclass(frozen=True, slots=True)
class Finished:
    """The database of a run that nobody disturbed: what a row is, once it is there."""

    rows: Mapping[datetime, Row]
    """Without their numbers."""
    calibrations: Mapping[int, Row]
    datums: Mapping[int, Row]
    """Links to the record's zero, by the number of the calibration that they were stored with."""
    causes: Mapping[datetime, str]


def read_database(path: Path) -> Finished:
    """Read it without our own code."""
    with closing(sqlite3.connect(path)) as connection:
        connection.row_factory = sqlite3.Row
        rows = connection.execute("SELECT * FROM measurement").fetchall()
        calibrations = connection.execute("SELECT * FROM calibration").fetchall()
        datums = connection.execute("SELECT * FROM datum").fetchall()
        causes = dict(_gap_slots(connection))
    return Finished(
        {datetime.fromisoformat(row["slot_utc"]): tuple(row)[1:] for row in rows},
        {row["id"]: tuple(row) for row in calibrations},
        {row["calibration_id"]: tuple(row) for row in datums},
        causes,
    )


def broken(
    state: Path, promised: Promises, finished: Finished, now_utc: datetime, *, twice: bool = True
) -> list[str]:
    """Recover what a cut left, as dcamd does at its start; tell each promise that is not kept.

    `twice`: a second recovery must find nothing to do.
    """
    try:
        with heard(lambda _: None):
            recover(state, now_utc, AFTER)
            found = list(_not_kept(state, promised, finished, now_utc))
            if twice:
                first = _everything(state)
                recover(state, now_utc, AFTER)
                if _everything(state) != first:
                    found.append("a second recovery changed something")
    except Exception as error:  # noqa: BLE001 - whatever it is, it does not come back by itself
        return [f"{type(error).__name__}: {error}"]
    return found


def recover(state: Path, now_utc: datetime, boot_id: str) -> None:
    """Start as dcamd does, and be killed before the first slot."""
    with daemon(state, now_utc, boot_id):
        pass


def _not_kept(
    state: Path, promised: Promises, finished: Finished, now_utc: datetime
) -> Iterator[str]:
    now = read_database(state / FILE_NAME)
    yield from _check_database(state / FILE_NAME)
    for slot in sorted(promised.rows):
        if slot not in now.rows:
            yield f"acknowledged row {slot} is lost"
        elif now.rows[slot] != finished.rows.get(slot):
            yield f"acknowledged row {slot} is another"
    for path, content in promised.files.items():
        if not (state / path).exists() or (state / path).read_bytes() != content:
            yield f"acknowledged frame {path} is lost or another"
    missing = len(promised.pictures - set(_pictures(state)))
    if missing:
        yield f"{missing} acknowledged frames are nowhere that a row names"
    yield from _check_slots(promised, finished, now, now_utc)
    yield from _check_history(state, promised, finished, now)
    yield from _check_frames(state, now)
    for name, slots in promised.backups.items():
        if not slots <= read_database(state.parent / name).rows.keys():
            yield f"backup {name} has not all rows"
    if not promised.damaged:
        yield from (f"{path.name}: a sound database" for path in state.glob(f"{SET_ASIDE}*"))
    for left_over in state.rglob(".*"):
        yield f"{left_over.name} was left lying"


def _check_slots(
    promised: Promises, finished: Finished, now: Finished, now_utc: datetime
) -> Iterator[str]:
    """Each slot since the start is a row or in a gap, once, with a cause that is true."""
    both = Counter([*now.rows, *now.causes])
    first = promised.first_slot_utc or min(both, default=now_utc)
    slot = first
    while slot < now_utc:
        if both.pop(slot, 0) != 1:
            yield f"slot {slot} is not accounted for exactly once"
        slot += STEP
    yield from (f"slot {slot} is accounted for, but never was" for slot in both)
    for slot, cause in now.causes.items():
        reported = promised.gaps.get(slot)
        true = {reported} if reported else {finished.causes.get(slot), *promised.absence}
        if promised.first_slot_utc and cause not in true:
            yield f"slot {slot} is missing because of {cause}, in truth {true}"


def _check_history(
    state: Path, promised: Promises, finished: Finished, now: Finished
) -> Iterator[str]:
    with closing(sqlite3.connect(state / FILE_NAME)) as connection:
        events = set(connection.execute("SELECT kind, detail FROM event"))
        active = connection.execute(
            "SELECT calibration_id FROM calibration_activation ORDER BY id DESC LIMIT 1"
        ).fetchone()
    if not promised.events <= events:
        yield f"events are lost: {promised.events - events}"
    (number,) = active or (0,)
    if number < promised.calibration_id:
        yield f"calibration {promised.calibration_id} was in use, now {number} is"
    for known, content in now.calibrations.items():
        if finished.calibrations.get(known) != content:
            yield f"calibration {known} is half made"
        if finished.datums.get(known) != now.datums.get(known):
            yield f"calibration {known} is stored without its datum"


def _check_frames(state: Path, now: Finished) -> Iterator[str]:
    """Every pair has a row; every line of a table names images that are those it tells of.

    But for the pair that was on its way to its true slot, and is still in its old place as well.
    """
    with closing(sqlite3.connect(state / FILE_NAME)) as connection:
        query = "SELECT value FROM mark WHERE name = 'moving_to_utc'"
        moving = {datetime.fromisoformat(slot) for (slot,) in connection.execute(query)}
    for table in state.glob("frames/*/*/*/frames.csv"):
        images = {path.name for path in table.parent.glob("*.png")}
        for line in csv.DictReader(table.read_text().splitlines()):
            for role in ("main", "sub"):
                image = table.parent / line[role]
                images.discard(image.name)
                if not image.exists():
                    yield f"{table}: {line[role]} is not there"
                elif hashlib.sha256(image.read_bytes()).hexdigest() != line[f"sha256_{role}"]:
                    yield f"{table}: {line[role]} is another"
            if datetime.fromisoformat(line["slot_utc"]) not in now.rows.keys() | moving:
                yield f"{table}: slot {line['slot_utc']} has frames, but no row"
        pairs = Counter(name.rpartition("_")[0] for name in images)
        yield from (f"{table}: pair {stem} has no line" for stem in pairs if pairs[stem] == 2)


def _pictures(state: Path) -> Iterator[bytes]:
    """The frames that rows name, those without a slot yet among them."""
    with closing(sqlite3.connect(state / FILE_NAME)) as connection:
        named = connection.execute("SELECT main_frame, sub_frame FROM measurement").fetchall()
        for (content,) in connection.execute("SELECT content FROM undated"):
            named.append([json.loads(content)[f"{role}_frame"] for role in ("main", "sub")])
    for names in named:
        yield from ((state / name).read_bytes() for name in names if name)


def _check_database(path: Path) -> Iterator[str]:
    with closing(sqlite3.connect(path)) as connection:
        (said,) = connection.execute("PRAGMA integrity_check").fetchone()
        if said != "ok":
            yield f"the database is damaged: {said}"
        yield from (
            f"a reference is broken: {row}"
            for row in connection.execute("PRAGMA foreign_key_check")
        )


def _everything(state: Path) -> dict[str, Any]:
    """Rows of all tables (without the numbers of events), and all other files."""
    with closing(sqlite3.connect(state / FILE_NAME)) as connection:
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        found: dict[str, Any] = {
            name: sorted(map(repr, connection.execute(f'SELECT * FROM "{name}"')))
            for (name,) in names
            if name != "event"
        }
    for path in state.parent.rglob("*"):
        if path.is_file() and not path.name.startswith(FILE_NAME + "-") and path.name != FILE_NAME:
            found[str(path)] = path.read_bytes()
    return found


def _gap_slots(connection: sqlite3.Connection) -> Iterator[tuple[datetime, str]]:
    query = "SELECT start_utc, slots, period_s, cause FROM gap"
    for start, slots, period_s, cause in connection.execute(query):
        first, step = datetime.fromisoformat(start), timedelta(seconds=period_s)
        yield from ((first + number * step, cause) for number in range(slots))
