"""What became of every slot of a stretch of the schedule."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import Integer, cast, func, select
from sqlalchemy.orm import Session

from core.results import Flag
from daemon.store.gaps import gaps_touching, next_second, overlap, run_of, slot_at, unix_s
from daemon.store.records import Coverage, GapCause
from daemon.store.schema import MeasurementRow


def schedule_slots(since: datetime, until: datetime, period_s: int, offset_s: int = 0) -> range:
    """Unix seconds of the slots `k * period + offset` with since <= slot < until."""
    if period_s < 1:
        msg = f"not a period: {period_s} s"
        raise ValueError(msg)
    start = unix_s(next_second(since))
    first = start + (offset_s - start) % period_s
    return range(first, max(first, unix_s(next_second(until))), period_s)


def coverage(session: Session, slots: range) -> Coverage:
    """Count the fate of each of `slots`."""
    if not slots:
        return Coverage(0, 0, 0, 0, 0, {}, 0)
    first, last = slot_at(slots[0]), slot_at(slots[-1])
    rows = _rows_by_flag(session, first, last, slots)
    gaps: dict[GapCause, int] = {}
    for gap in gaps_touching(session, first, last):
        shared = overlap(run_of(gap), slots)
        if shared:
            gaps[gap.cause] = gaps.get(gap.cause, 0) + shared
    return Coverage(
        expected=len(slots),
        good=rows.get(Flag.GOOD, 0),
        suspect=rows.get(Flag.SUSPECT, 0),
        bad=rows.get(Flag.BAD, 0),
        missing=rows.get(Flag.MISSING, 0),
        gaps=gaps,
        unaccounted=len(slots) - sum(rows.values()) - sum(gaps.values()),
    )


def _rows_by_flag(
    session: Session, first: datetime, last: datetime, slots: range
) -> dict[Flag, int]:
    seconds = cast(func.strftime("%s", MeasurementRow.slot_utc), Integer)
    query = (
        select(MeasurementRow.flag, func.count())
        .where(MeasurementRow.slot_utc.between(first, last))
        .where((seconds - slots.start) % slots.step == 0)
        .group_by(MeasurementRow.flag)
    )
    return {Flag(flag): count for flag, count in session.execute(query)}
