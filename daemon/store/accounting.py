"""Every slot of the schedule exactly once: which have neither row nor gap, and which have both."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from daemon.errors import DamagedRowError
from daemon.store.runs import run_between, schedule_slots, slot_at, unix_s, without
from daemon.store.sqlite import connect_readonly, said_plainly
from daemon.times import slot_text

_STEP = 50_000
"""Slots looked at in one transaction: a month of minutes, a tenth of a second."""


@dataclass(frozen=True, slots=True)
class SlotAudit:
    """What is wrong with the slots of a short stretch."""

    slots: range
    """Unix seconds: the stretch."""
    missing_slots: tuple[range, ...]
    """Slots with neither row nor gap."""
    doubled: tuple[int, ...]
    """Slots with a row, or a gap, and in another gap too."""


def audit_slots(connection: sqlite3.Connection, slots: range) -> Iterator[SlotAudit]:
    """Look at `slots` in short stretches, each by itself, in order. Raises DamagedRowError."""
    for start in range(0, len(slots), _STEP):
        yield _fate(connection, slots[start : start + _STEP])


def missing_slots(path: Path, slots: range) -> Iterator[range]:
    """Those of `slots` with neither row nor gap, as runs, in order. Raises StoreError.

    Each short stretch is looked at by itself, so that no writer waits and no log grows.
    """
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        for audit in audit_slots(connection, slots):
            yield from audit.missing_slots


def _fate(connection: sqlite3.Connection, slots: range) -> SlotAudit:
    limits = (slot_text(slot_at(slots[0])), slot_text(slot_at(slots[-1])))
    with closing(connection.cursor()) as cursor:
        cursor.execute("BEGIN")
        rows = cursor.execute(
            "SELECT CAST(strftime('%s', slot_utc) AS INTEGER) FROM measurement"
            " WHERE slot_utc BETWEEN ? AND ?",
            limits,
        ).fetchall()
        gaps = cursor.execute(
            "SELECT start_utc, end_utc, period_s FROM gap WHERE end_utc >= ? AND start_utc <= ?",
            limits,
        ).fetchall()
        cursor.execute("COMMIT")
    known = {slot for (slot,) in rows}
    doubled = []
    for gap in gaps:
        missed = _shared(_run(*gap), slots)
        doubled += [slot for slot in missed if slot in known]
        known.update(missed)
    return SlotAudit(slots, tuple(without(slots, known)), tuple(sorted(doubled)))


def _run(start: str, end: str, period_s: int) -> range:
    try:
        return run_between(datetime.fromisoformat(start), datetime.fromisoformat(end), period_s)
    except (ValueError, TypeError) as error:
        msg = f"a gap from {start!r} to {end!r} is none"
        raise DamagedRowError(msg) from error


def _shared(missed: range, slots: range) -> range:
    """The part of a gap that lies within a stretch, whatever the stretch's period is."""
    before = max(0, -((missed.start - slots[0]) // missed.step))
    return range(missed.start + before * missed.step, min(missed.stop, slots[-1] + 1), missed.step)


@dataclass(frozen=True, slots=True)
class ScheduleEpoch:
    """A schedule, and from when on it was the site's."""

    after_utc: datetime | None
    """The last slot that was accounted for by the schedule before; None for the first."""
    period_s: int
    offset_s: int


def read_epochs(noted: str | None) -> list[ScheduleEpoch]:
    """The schedules of a site in order, from their mark. Raises DamagedRowError."""
    try:
        return [
            ScheduleEpoch(datetime.fromisoformat(after) if after else None, period_s, offset_s)
            for after, period_s, offset_s in json.loads(noted or "[]")
        ]
    except (ValueError, TypeError) as error:
        msg = f"the mark of the schedules is not what was written: {noted!r}"
        raise DamagedRowError(msg) from error


def epochs_text(epochs: list[ScheduleEpoch]) -> str:
    """What the mark holds."""
    return json.dumps(
        [
            [slot_text(epoch.after_utc) if epoch.after_utc else "", epoch.period_s, epoch.offset_s]
            for epoch in epochs
        ]
    )


def scheduled(
    epochs: list[ScheduleEpoch], first_utc: datetime, last_utc: datetime
) -> Iterator[range]:
    """The slots from one moment to another, both included, by the schedule of their time."""
    ends = [epoch.after_utc for epoch in epochs[1:]]
    for epoch, end_utc in zip(epochs, [*ends, None], strict=True):
        begin = unix_s(first_utc) if epoch.after_utc is None else unix_s(epoch.after_utc) + 1
        begin = max(begin, unix_s(first_utc))
        end = unix_s(last_utc) if end_utc is None else min(unix_s(end_utc), unix_s(last_utc))
        limits = slot_at(begin), slot_at(max(begin, end + 1))
        if slots := schedule_slots(*limits, epoch.period_s, epoch.offset_s):
            yield slots
