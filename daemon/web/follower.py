"""Follows the record: a thread that keeps the pyramid true to the database, and never writes there.

It looks every few seconds, for new rows first. Days whose rows were written late, moved or removed
are found by their digests: a slow round goes over all days, for ever. Each look, and each day, is a
short transaction of its own, so that no reader keeps the write-ahead log from being emptied.
"""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

from daemon.errors import StoreError
from daemon.store.integrity.reading import fetch, value
from daemon.store.queries.chart_rows import (
    chart_rows,
    day_digest,
    days_with_rows,
    moved_rows,
    span_of_calibration,
)
from daemon.store.queries.overview import Overview
from daemon.store.records import Mark
from daemon.store.revisions import require_head
from daemon.store.rows.datum import Datums, read_datums
from daemon.store.sqlite import connect_readonly, existing_path, said_plainly
from daemon.web.memory import Spare
from daemon.web.pyramid import DAY_S, EPOCH_S, Pyramid, digest_of, lowest_width_s

LOOK_S = 3.0
"""From one look at the database to the next."""
FIRST_LOOK_S = 2.0
"""After the start, for which a reader waits: a young record is built by then."""
_PAUSE_S = 0.01
"""After each day of a first build: others want the processor too."""
_SAVE_DAYS = 200
_VERSION = 1
_NEVER = "9999"


@dataclass(slots=True)
class Known:
    """What the pyramid was made from; kept beside it."""

    version: int = _VERSION
    identity: str = ""
    """Which database: its own name, and the file."""
    lowest_s: int = 0
    last_id: int = 0
    last_digest: int | None = None
    links: dict[str, int] = field(default_factory=dict)
    """The datum link of each calibration, by its number."""
    moved: str = ""
    """Fingerprint of rows whose time was put right."""
    dirty: list[int] = field(default_factory=list)
    """Days that wait, in the order of their turns."""
    build_before: str | None = _NEVER
    """The first build goes on with the day before this one; None when it is complete."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the pyramid is."""

    complete: bool
    share: float
    """Of the record's time that is in it."""
    changes: int
    """Grows with every change of what is shown."""
    trouble: str
    """Why the record cannot be read; empty when it can."""


class Follower(threading.Thread):
    """One for each state directory and cache; a second one only reads what the first makes."""

    def __init__(self, state: Path, cache: Path, period_s: int) -> None:
        super().__init__(name="follower", daemon=True)
        self.pyramid = Pyramid(cache / "pyramid", lowest_width_s(period_s))
        self._state = state
        self._cache = cache
        self._known = Known()
        self._changes = 0
        self._trouble = ""
        self._share = 0.0
        self._complete = False
        self._round = 0
        self._patience_s = time.monotonic() + FIRST_LOOK_S
        self._wake = threading.Event()
        self._ended = threading.Event()
        self._current = threading.Event()
        self._lock: int | None = None
        self._spare = Spare()

    def progress(self) -> Progress:
        """How far it is."""
        return Progress(self._complete, self._share, self._changes, self._trouble)

    def wait_current(self) -> None:
        """Wait until the first look and build are over; no longer than a moment after the start."""
        self._current.wait(max(self._patience_s - time.monotonic(), 0.0))

    def stop(self) -> None:
        """End soon."""
        self._ended.set()
        self._wake.set()
        if self.is_alive():
            self.join(5.0)

    def run(self) -> None:
        """Follow until stopped."""
        while not self._ended.is_set():
            try:
                self.look()
                self._trouble = ""
            except StoreError as error:
                self._trouble = str(error)
            except OSError as error:
                self._trouble = f"{self._cache}: {error.strerror or error}"
            self._current.set()
            self._spare.give_back()
            self._wake.wait(LOOK_S)
            self._wake.clear()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def look(self) -> None:
        """Take in what has changed since the last look. Raises StoreError, OSError."""
        if not self._is_first():
            self._complete, self._share = True, 1.0
            self._changes += 1  # another process may have changed anything
            return
        with self._connection() as connection:
            self._settle(connection)
            self._find_new(connection)
        self._work_off()
        self._go_round()
        self._save()

    def _is_first(self) -> bool:
        """Whether the cache is ours to write."""
        if self._lock is None:
            self._cache.mkdir(parents=True, exist_ok=True)
            file = os.open(self._cache / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(file)
                return False
            self._lock = file
            self._load()
        return True

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        """One transaction for reading."""
        path = existing_path(self._state)
        with said_plainly(path), closing(connect_readonly(path)) as connection:
            connection.execute("BEGIN").close()
            require_head(Overview(connection).revision(), path)
            yield connection

    def _settle(self, connection: sqlite3.Connection) -> None:
        """Begin again where this is another database, or one that was put back."""
        named = value(connection, "SELECT value FROM mark WHERE name = ?", Mark.IDENTITY.value)
        found = existing_path(self._state).stat()
        identity = f"{named} {found.st_dev} {found.st_ino}"
        known = self._known
        same = (known.identity, known.lowest_s) == (identity, self.pyramid.lowest_s)
        if not same:
            self.pyramid.clear()
            self._known = Known(identity=identity, lowest_s=self.pyramid.lowest_s)
            self._complete, self._round = False, 0
            return
        digest = value(connection, "SELECT digest FROM measurement WHERE id = ?", known.last_id)
        if known.last_id and digest != known.last_digest:
            self._know_last(connection)
            self._distrust(connection)
        links = {str(number): link.id or 0 for number, link in read_datums(connection).items()}
        for number in set(links) | set(known.links):
            if links.get(number) != known.links.get(number):
                span = span_of_calibration(connection, int(number))
                self._add_dirty(*(span or ("", "")))
        known.links = links
        moved = moved_rows(connection)
        if moved != known.moved:
            known.moved = moved
            self._distrust(connection)

    def _distrust(self, connection: sqlite3.Connection) -> None:
        """Compare all days at once."""
        first = value(connection, "SELECT min(slot_utc) FROM measurement")
        last = value(connection, "SELECT max(slot_utc) FROM measurement")
        there = self._days_known()
        for day in sorted({*_days(first or "", last or ""), *there}, reverse=True):
            if self._differs(connection, day):
                self._mark(day)

    def _days_known(self) -> list[int]:
        days = self.pyramid.read_days(0, _day_number(datetime.now(UTC)) + 366)
        return [int(day) for day in days["rows"].nonzero()[0]]

    def _differs(self, connection: sqlite3.Connection, day: int) -> bool:
        rows, digest = day_digest(connection, *_limits(day))
        kept = self.pyramid.read_days(day, 1)[0]
        return (rows, digest_of(digest)) != (int(kept["rows"]), int(kept["digest"]))

    def _know_last(self, connection: sqlite3.Connection) -> None:
        query = "SELECT id, digest FROM measurement ORDER BY id DESC LIMIT 1"
        found = fetch(connection, query)
        self._known.last_id, self._known.last_digest = found[0] if found else (0, None)

    def _find_new(self, connection: sqlite3.Connection) -> None:
        """Mark the days of rows that were written since, whenever their slots were."""
        known = self._known
        if known.build_before == _NEVER:  # all of it is new
            self._know_last(connection)
            known.links = {
                str(number): link.id or 0 for number, link in read_datums(connection).items()
            }
            known.moved = moved_rows(connection)
            return
        query = "SELECT DISTINCT substr(slot_utc, 1, 10) FROM measurement WHERE id > ?"
        for (day,) in fetch(connection, query, known.last_id):
            self._add_dirty(day, day)
        self._know_last(connection)

    def _add_dirty(self, first: str, last: str) -> None:
        for day in _days(first, last):
            self._mark(day)

    def _mark(self, day: int) -> None:
        if day >= 0 and day not in self._known.dirty:
            self._known.dirty.append(day)

    def _work_off(self) -> None:
        """Read the days that wait, then those of a first build, newest first."""
        while self._known.dirty and not self._ended.is_set():
            with self._connection() as connection:
                self._read_day(connection, self._known.dirty[-1])
            self._known.dirty.pop()
        done = 0
        while self._known.build_before is not None and not self._ended.is_set():
            with self._connection() as connection:
                self._build_next(connection)
            done += 1
            if done % _SAVE_DAYS == 0:
                self._save()
            self._ended.wait(_PAUSE_S)
        if self._known.build_before is None:
            self._complete, self._share = True, 1.0

    def _build_next(self, connection: sqlite3.Connection) -> None:
        known = self._known
        day = next(days_with_rows(connection, known.build_before or ""), None)
        if day is None or day < "2000":
            known.build_before = None
            return
        self._read_day(connection, _days(day, day)[0])
        known.build_before = day
        first, last = fetch(
            connection,
            "SELECT (SELECT min(slot_utc) FROM measurement),"
            " (SELECT max(slot_utc) FROM measurement)",
        )[0]
        days = _days(first, last)
        self._share = (days[-1] - _days(day, day)[0] + 1) / max(len(days), 1) if days else 1.0

    def _read_day(self, connection: sqlite3.Connection, day: int) -> None:
        since, until = _limits(day)
        datums: Datums = read_datums(connection)
        rows = chart_rows(connection, since, until, datums)
        self.pyramid.write_day(day, rows, _frame_s(connection, day))
        self._changes += 1

    def _go_round(self) -> None:
        """Compare one more day with the record."""
        if not self._complete or not (days := self._days_known()):
            return
        self._round += 1
        day = days[-1 - self._round % len(days)]
        with self._connection() as connection:
            if self._differs(connection, day):
                self._read_day(connection, day)

    def _load(self) -> None:
        try:
            content = json.loads((self._cache / "known.json").read_text(encoding="utf-8"))
            if content.get("version") == _VERSION:
                self._known = Known(**content)
        except (OSError, ValueError, TypeError):
            self._known = Known()

    def _save(self) -> None:
        text = json.dumps(asdict(self._known))
        path = self._cache / "known.json"
        with suppress(FileNotFoundError):
            if path.read_text(encoding="utf-8") == text:
                return
        part = path.with_suffix(".part")
        part.write_text(text, encoding="utf-8")
        part.replace(path)


def _frame_s(connection: sqlite3.Connection, day: int) -> int:
    """The slot nearest after noon (or else the last before) that kept its frames; 0 without any."""
    since, until = _limits(day)
    noon = f"{since[:10]}T12:00:00Z"
    query = (
        "SELECT CAST(strftime('%s', slot_utc) AS INTEGER) FROM measurement"
        " WHERE slot_utc >= ? AND slot_utc < ? AND main_frame IS NOT NULL ORDER BY slot_utc"
    )
    after = value(connection, query + " LIMIT 1", noon, until)
    return int(after or value(connection, query + " DESC LIMIT 1", since, noon) or 0)


def _day_number(when: datetime) -> int:
    return (int(when.timestamp()) - EPOCH_S) // DAY_S


def day_text(day: int) -> str:
    """A day's number since 2000 as `2026-03-01`."""
    return (datetime(2000, 1, 1, tzinfo=UTC) + timedelta(days=day)).strftime("%Y-%m-%d")


def _limits(day: int) -> tuple[str, str]:
    """A day's ends as the table holds slots."""
    return f"{day_text(day)}T00:00:00Z", f"{day_text(day + 1)}T00:00:00Z"


def _days(first: str, last: str) -> list[int]:
    """The numbers of the days from one slot to another."""
    try:
        begin, end = (
            datetime.fromisoformat(text[:10]).replace(tzinfo=UTC) for text in (first, last)
        )
    except ValueError:
        return []
    return list(range(max(_day_number(begin), 0), _day_number(end) + 1))
