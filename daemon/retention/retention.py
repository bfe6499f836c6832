"""Removing frames by the rules, in small steps between slots.

What is to go is written down before the first file of a day is removed, so that what is missing
later is known to have been removed and not lost. Only pairs whose slot has its row are removed:
a pair that was not measured yet, whatever its age, is the only trace of its slot.
"""

from __future__ import annotations

import shutil
from collections import deque
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import structlog

from daemon.errors import DiskFullError
from daemon.retention.events import day_start, slots_beside_events
from daemon.retention.rules import NEWEST, Rules, chosen
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive
from daemon.store.frames.removal import bytes_of_day, files_of_day, finish_removal
from daemon.store.records import FrameDay, Thinning
from daemon.text import bytes_text
from drivers.protocols import Clock

_log = structlog.get_logger("dcam.daemon")

MOST_FILES = 400
"""Removed in one step: many times what a slot adds, yet soon done on a slow disk."""
RECOUNT = timedelta(hours=1)
"""How old the size of the newest day may be."""

_DAY = timedelta(days=1)
_SECOND = timedelta(seconds=1)


@dataclass(slots=True)
class _Job:
    """A day that is being thinned."""

    record: FrameDay
    """As it will be at the end, but for the size."""
    files: deque[Path]
    written: bool
    """Whether the record is in the database: on a full disk files may have to go first."""


class Retention:
    """Keeps the frame archive within the rules; one step after each slot."""

    def __init__(self, store: Store, archive: FrameArchive, rules: Rules, clock: Clock) -> None:
        self._store = store
        self._archive = archive
        self._rules = rules
        self._clock = clock
        self._days: dict[date, FrameDay | None] = {}
        """Every day with a directory; None until it has been counted."""
        self._listed_on: date | None = None
        self._counted: datetime | None = None
        """The slot at which the newest day was counted."""
        self._job: _Job | None = None
        self._troubled: dict[date, str] = {}
        """Days that could not be thinned or counted; they are tried again the next day."""

    @property
    def free_bytes(self) -> int:
        """Free space where the frames lie. Raises OSError."""
        place = self._archive.directory
        return shutil.disk_usage(place if place.is_dir() else self._archive.state).free

    def step(self, slot_utc: datetime, deadline_s: float) -> bool:
        """Do what is most urgent until a monotonic time; False when there was nothing to do.

        `slot_utc` is the last slot. Each file is one bite: none is begun after the deadline.
        Raises StoreError.
        """
        self._look(slot_utc)
        if self._job is None:
            self._job = self._next_job(slot_utc)
        if self._job is None:
            return self._count_next(slot_utc)
        day = self._job.record.day
        try:
            self._advance(self._job, slot_utc, deadline_s)
        except OSError as error:
            self._job = None
            self._set_aside(day, error)
        return True

    def _look(self, slot_utc: datetime) -> None:
        """List the days, once a day: few directories even after many years. Raises StoreError."""
        today = slot_utc.astimezone(UTC).date()
        if self._listed_on == today:
            if self._archive.day_directory(today).is_dir():
                self._days.setdefault(today, None)
            return
        known = {record.day: record for record in self._store.frame_days()}
        self._days = {day: known.get(day) for day in self._archive.days()}
        self._troubled.clear()
        self._listed_on = today

    def _next_job(self, slot_utc: datetime) -> _Job | None:
        """What was begun, what there is no room for, what is due; in this order."""
        ordered = sorted(day for day in self._days if day not in self._troubled)
        # A day that ended within the newest hour is not thinned yet.
        newest = {(slot_utc - past).astimezone(UTC).date() for past in (timedelta(), NEWEST)}
        newest.add(max(self._days, default=date.min))
        older = [_as_is(self._days[day] or FrameDay(day)) for day in ordered if day not in newest]
        for record in older:
            if not record.finished:
                return self._resume(record)
        target = self._pressed(older, slot_utc) or self._due(older)
        return None if target is None else self._plan(*target, slot_utc)

    def _due(self, older: list[FrameDay]) -> tuple[FrameDay, Thinning] | None:
        """The oldest day that has more than its age allows."""
        steps = list(Thinning)
        for at, record in enumerate(older):
            level = self._rules.level_due(len(older) - at)
            if steps.index(record.level) < steps.index(level):
                return record, level
        return None

    def _pressed(
        self, older: list[FrameDay], slot_utc: datetime
    ) -> tuple[FrameDay, Thinning] | None:
        """The day to thin where room is short: events go only where rows would soon have none."""
        free = self.free_bytes
        total = sum(record.bytes for record in self._days.values() if record)
        if free >= self._rules.min_free_bytes and total <= self._rules.max_bytes:
            return None
        victim = self._rules.first_to_go(older)
        if victim is not None:
            return victim, victim.level.next
        today = slot_utc.astimezone(UTC).date()
        record = self._days.get(today) or FrameDay(today)
        if today in self._days and (record.until_utc or day_start(today)) < slot_utc - 2 * NEWEST:
            return record, Thinning.HOURLY
        last = next((one for one in older if one.level is Thinning.EVENTS), None)
        if last is not None and free < 2 * self._rules.reserve_bytes:
            return last, Thinning.NOTHING
        return None

    def _plan(self, record: FrameDay, level: Thinning, slot_utc: datetime) -> _Job | None:
        """Choose what goes of a day. Raises StoreError."""
        start = day_start(record.day)
        until_utc = min(start + _DAY - _SECOND, slot_utc - NEWEST)
        directory = self._archive.day_directory(record.day)
        try:
            files = files_of_day(directory)
        except OSError as error:
            self._set_aside(record.day, error)
            return None
        rows = self._store.reasons(start, start + _DAY)
        whole = files.whole
        measured = {slot: said for slot, said in rows.items() if slot in whole}
        stay = chosen(measured, level, slots_beside_events(self._store, record.day, rows))
        stay |= whole - rows.keys()
        going = [slot for slot in files.images if slot <= until_utc and slot not in stay]
        planned = replace(
            record,
            level=level,
            until_utc=until_utc,
            kept=frozenset(slot for slot in stay if slot <= until_utc),
            removed=record.removed + len(whole.intersection(going)),
            finished=False,
        )
        names = (directory / name for slot in going for name in files.images[slot])
        return _Job(planned, deque(names), written=False)

    def _resume(self, record: FrameDay) -> _Job | None:
        """Take up a day that was cut off: what it said would stay stays, the rest goes."""
        directory = self._archive.day_directory(record.day)
        try:
            images = files_of_day(directory).images if directory.is_dir() else {}
        except OSError as error:
            self._set_aside(record.day, error)
            return None
        going = [slot for slot in images if record.has_removed(slot)]
        names = (directory / name for slot in going for name in images[slot])
        return _Job(record, deque(names), written=True)

    def _advance(self, job: _Job, slot_utc: datetime, deadline_s: float) -> None:
        """Remove what there is time for; at the end tell what was done.

        Raises StoreError, OSError.
        """
        self._write(job)
        for _ in range(MOST_FILES):
            if not job.files:
                break
            if self._clock.monotonic_s() >= deadline_s:
                return
            job.files[0].unlink(missing_ok=True)
            job.files.popleft()
        if job.files or self._clock.monotonic_s() >= deadline_s:
            return
        directory = self._archive.day_directory(job.record.day)
        before = self._days.get(job.record.day) or job.record
        finish_removal(directory)
        there = directory.is_dir()
        done = replace(job.record, bytes=bytes_of_day(directory) if there else 0, finished=True)
        self._store.put_frame_day(done)
        self._job = None
        if there:
            self._days[done.day] = done
        else:
            self._days.pop(done.day, None)
        if done.removed > before.removed or before is job.record:
            self._tell(done, before.bytes - done.bytes, slot_utc)

    def _write(self, job: _Job) -> None:
        """Write down what will go; where there is no room for that, room is made first."""
        if job.written:
            return
        try:
            self._store.put_frame_day(job.record)
        except DiskFullError:
            return
        job.written = True

    def _tell(self, done: FrameDay, freed_bytes: int, slot_utc: datetime) -> None:
        detail = (
            f"{done.day}: {done.removed} slots removed in all, {len(done.kept)} kept "
            f"({done.level.value}), {bytes_text(max(freed_bytes, 0))} freed"
        )
        _log.info("frames_removed", day=str(done.day), level=done.level.value, slots=done.removed)
        self._store.add_event(slot_utc, "frames_removed", detail)

    def _count_next(self, slot_utc: datetime) -> bool:
        """Count a day that has not been counted, or the newest one again. Raises StoreError."""
        today = slot_utc.astimezone(UTC).date()
        waiting = [day for day, record in self._days.items() if record is None]
        day = next(
            (day for day in sorted(waiting, reverse=True) if day not in self._troubled), None
        )
        is_old = self._counted is None or abs(slot_utc - self._counted) >= RECOUNT
        if day is None and is_old and today in self._days and today not in self._troubled:
            day = today
        if day is None:
            return False
        self._counted = slot_utc if day == today else self._counted
        try:
            size = bytes_of_day(self._archive.day_directory(day))
        except OSError as error:
            self._set_aside(day, error)
            return True
        record = replace(self._days[day] or FrameDay(day), bytes=size)
        self._store.put_frame_day(record)
        self._days[day] = record
        return True

    def _set_aside(self, day: date, error: OSError) -> None:
        """Leave a day alone until tomorrow, and say so once."""
        where = error.filename or self._archive.day_directory(day)
        self._troubled[day] = str(error)
        _log.error("day_not_thinned", day=str(day), error=f"{where}: {error.strerror}")


def _as_is(record: FrameDay) -> FrameDay:
    """A day that was thinned before it was over counts as one that was not."""
    last_utc = day_start(record.day) + _DAY - _SECOND
    if record.until_utc is None or record.until_utc >= last_utc:
        return record
    return replace(record, level=Thinning.EVERY_SLOT)
