"""Missed slots: kept as runs, never over a measured slot, never twice."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from daemon.store.records import GapCause
from daemon.store.runs import run_between, slot_at, unix_s, without
from daemon.store.schema import GapRow, MeasurementRow


def record_missed(session: Session, slots: range, cause: GapCause, detail: str) -> int:
    """Put those of `slots` that nothing accounts for into gaps; give their number.

    A gap of the same cause and period that they continue is extended and keeps its detail.
    """
    first, last = slot_at(slots[0]), slot_at(slots[-1])
    measured = session.scalars(
        select(MeasurementRow.slot_utc).where(MeasurementRow.slot_utc.between(first, last))
    )
    taken = {unix_s(slot) for slot in measured}
    for gap in gaps_touching(session, first, last):
        taken.update(slot for slot in run_of(gap) if slot in slots)
    runs = list(without(slots, taken))
    for run in runs:
        _join(session, run, cause, detail)
    return sum(len(run) for run in runs)


def release(session: Session, slot_utc: datetime) -> None:
    """Take a slot that has been measured after all out of the gap that holds it."""
    slot = unix_s(slot_utc)
    for gap in gaps_touching(session, slot_utc, slot_utc):
        slots = run_of(gap)
        if slot in slots:
            session.execute(delete(GapRow).where(GapRow.id == gap.id))
            rests = without(slots, [slot])
            session.add_all(_row(run, gap.cause, gap.detail) for run in rests)
            session.flush()


def release_after(session: Session, slot_utc: datetime) -> None:
    """Cut gaps short that go on beyond a slot: a clock that was ahead had put them there."""
    last = unix_s(slot_utc)
    for gap in session.scalars(select(GapRow).where(GapRow.end_utc > slot_utc)):
        slots = run_of(gap)
        kept = range(slots.start, min(slots.stop, last + 1), slots.step)
        _replace(session, gap, [(kept, gap.cause, gap.detail)])


def change_cause(
    session: Session, since: datetime, last: datetime, old: GapCause, new: GapCause, detail: str
) -> None:
    """Give the slots from `since` to `last` that lie in gaps of the old cause the new one."""
    for gap in gaps_touching(session, since, last):
        if gap.cause is not old:
            continue
        slots = run_of(gap)
        first = bisect_left(slots, unix_s(since))
        end = bisect_right(slots, unix_s(last))
        parts = [slots[:first], slots[first:end], slots[end:]]
        causes = [(old, gap.detail), (new, detail), (old, gap.detail)]
        _replace(session, gap, [(part, *why) for part, why in zip(parts, causes, strict=True)])


def _replace(session: Session, gap: GapRow, parts: Sequence[tuple[range, GapCause, str]]) -> None:
    session.execute(delete(GapRow).where(GapRow.id == gap.id))
    session.flush()
    session.add_all(_row(run, cause, detail) for run, cause, detail in parts if run)
    session.flush()


def gaps_touching(session: Session, first: datetime, last: datetime) -> list[GapRow]:
    """Gaps whose time from start to end meets [first, last], in order."""
    query = select(GapRow).where(GapRow.end_utc >= first, GapRow.start_utc <= last)
    return list(session.scalars(query.order_by(GapRow.start_utc)))


def run_of(gap: GapRow) -> range:
    """The slots of a gap."""
    return run_between(gap.start_utc, gap.end_utc, gap.period_s)


def _row(run: range, cause: GapCause, detail: str) -> GapRow:
    return GapRow(
        start_utc=slot_at(run[0]),
        end_utc=slot_at(run[-1]),
        slots=len(run),
        period_s=run.step,
        cause=cause,
        detail=detail,
    )


def _join(session: Session, run: range, cause: GapCause, detail: str) -> None:
    alike = select(GapRow).where(GapRow.cause == cause, GapRow.period_s == run.step)
    before = session.scalar(alike.where(GapRow.end_utc == slot_at(run.start - run.step)))
    after = session.scalar(alike.where(GapRow.start_utc == slot_at(run[-1] + run.step)))
    kept = before or after
    if kept is None:
        session.add(_row(run, cause, detail))
        session.flush()
        return
    start = unix_s(before.start_utc) if before else run.start
    end = unix_s(after.end_utc) if after else run[-1]
    if before and after:
        session.execute(delete(GapRow).where(GapRow.id == after.id))
    kept.start_utc, kept.end_utc = slot_at(start), slot_at(end)
    kept.slots = (end - start) // run.step + 1
    session.flush()
