"""The archive's ledger: a row a day of what is kept and what was removed on purpose."""

from __future__ import annotations

from datetime import UTC, date, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from daemon.store.records import FrameDay, Thinning
from daemon.store.schema import FrameDayRow

_TIME_OF_DAY = "%H%M%S"


def put(session: Session, record: FrameDay) -> None:
    """Write a day's row, or replace it."""
    row = session.get(FrameDayRow, record.day.isoformat())
    if row is None:
        row = FrameDayRow(day=record.day.isoformat())
        session.add(row)
    row.level = record.level.value
    row.until_utc = record.until_utc
    row.kept = " ".join(slot.strftime(_TIME_OF_DAY) for slot in sorted(record.kept))
    row.removed, row.bytes, row.finished = record.removed, record.bytes, record.finished


def has_removed(session: Session, slot_utc: datetime) -> bool:
    """Whether the frames of a slot were removed on purpose."""
    row = session.get(FrameDayRow, slot_utc.astimezone(UTC).date().isoformat())
    return row is not None and _record(row).has_removed(slot_utc)


def read_all(session: Session) -> list[FrameDay]:
    """All days, in order."""
    rows = session.scalars(select(FrameDayRow).order_by(FrameDayRow.day))
    return [_record(row) for row in rows]


def _record(row: FrameDayRow) -> FrameDay:
    day = date.fromisoformat(row.day)
    times = (datetime.strptime(text, _TIME_OF_DAY).time() for text in row.kept.split())  # noqa: DTZ007 - a time of day
    return FrameDay(
        day=day,
        level=Thinning(row.level),
        until_utc=row.until_utc,
        kept=frozenset(datetime.combine(day, time, UTC) for time in times),
        removed=row.removed,
        bytes=row.bytes,
        finished=row.finished,
    )
