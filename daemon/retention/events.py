"""Which pairs are always kept: those on both sides of what happened to the station.

Of a day, the last pair before and the first one after

- each line of the history (start, stop, calibration, camera lost and back, disk full ...),
- each gap of an hour or more,
- each change of the reasons that tell of the rig itself (board slipped, camera bumped ...).

A station that fails all the time has many of them: no more than MOST a day, the first ones.
Frames of calibrations, the reference among them, lie in directories of their own, and are not
touched at all.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from datetime import UTC, date, datetime, time, timedelta

from core.results import Reason
from daemon.store.database import Store

MOST = 24
"""Pairs a day: as many as one an hour."""
LONG_GAP = timedelta(hours=1)
OF_THE_RIG = frozenset(
    {
        Reason.BOARD_SLIPPED.value,
        Reason.CAMERA_BUMPED.value,
        Reason.SUB_TARGET_CHANGED.value,
        Reason.CALIBRATION_DRIFTING.value,
    }
)
NOT_EVENTS = frozenset({"frames_removed"})
"""Lines of the history that retention itself writes."""

_DAY = timedelta(days=1)


def day_start(day: date) -> datetime:
    """The first moment of a day, UTC."""
    return datetime.combine(day, time(), UTC)


def slots_beside_events(store: Store, day: date, rows: dict[datetime, str]) -> set[datetime]:
    """The slots of a day that are always kept, of its rows (slot to reasons). Raises StoreError."""
    slots = sorted(rows)
    found: list[datetime] = []
    for moment in sorted(_moments(store, day, rows)):
        at = bisect_left(slots, moment)
        found += slots[max(at - 1, 0) : at + 1]
    return set(list(dict.fromkeys(found))[:MOST])


def _moments(store: Store, day: date, rows: dict[datetime, str]) -> Iterator[datetime]:
    """When something happened: pairs before and from each moment on are kept."""
    start = day_start(day)
    for event in store.events(start, start + _DAY):
        if event.kind not in NOT_EVENTS:
            yield event.time_utc
    for gap in store.gaps(start - timedelta(seconds=1), start + _DAY):
        if gap.last_slot_utc - gap.first_slot_utc >= LONG_GAP:
            yield from (end for end in (gap.first_slot_utc, gap.last_slot_utc) if _is_on(day, end))
    before: frozenset[str] | None = None
    for slot, reasons in rows.items():
        said = OF_THE_RIG.intersection(reasons.split("+"))
        if before is not None and said != before:
            yield slot
        before = said


def _is_on(day: date, moment: datetime) -> bool:
    return moment.astimezone(UTC).date() == day
