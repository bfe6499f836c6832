"""Coming back: account for the time without a daemon, and measure what was left half done.

Everything here may be cut off and done again: a gap once recorded stays as it is, and a pair that
has its row is no longer looked at.
"""

from __future__ import annotations

from datetime import datetime, timedelta

import structlog

from daemon.clock.downtime import Absence, absence_text, read_absence, why_absent
from daemon.errors import StoreError
from daemon.schedule import SECOND, Schedule
from daemon.slots.missing_slots import account_for_lost, note_schedule
from daemon.slots.pipeline import SlotContext, record_late
from daemon.slots.time_correction import finish_moves, mend_undated
from daemon.store.database import Store
from daemon.store.records import GapCause, Mark
from daemon.times import EPOCH, instant_text, slot_text

_log = structlog.get_logger("dcam.daemon")

LOOK_BACK = timedelta(days=7)
"""How far before the last row pairs without a row are looked for: the archive may hold years."""


def recover(context: SlotContext, schedule: Schedule) -> datetime | None:
    """Bring the record up to the present; give the last slot that is accounted for.

    Slots since the last finished one become a gap with the cause of the absence; pairs without a
    row are measured and recorded late, which takes their slots out of the gap again. Raises
    StoreError.
    """
    note_schedule(context.store, schedule)
    cause, detail = why_absent(context.store, context.machine.boot_id)
    close_gap(context, schedule, cause, detail)
    mark_start(context, schedule, cause, detail)
    last_row = context.store.last_slot()
    since = EPOCH if last_row is None else last_row - LOOK_BACK
    context.archive.repair(since)
    mend_undated(context)
    measure_orphans(context, since)
    account_for_lost(context)
    # Late rows take their time; what was missed meanwhile has the same cause.
    return close_gap(context, schedule, cause, detail)


def close_gap(
    context: SlotContext, schedule: Schedule, cause: GapCause, detail: str
) -> datetime | None:
    """Put the slots since the last finished one, up to the next one, into a gap.

    Gives the last slot accounted for, None when the record has not begun. Raises StoreError.
    """
    finished = _mark_time(context.store, Mark.HEARTBEAT_UTC)
    accounted = context.store.accounted()
    last = accounted[1] if accounted else finished
    if last is None:
        return None
    now_utc = context.clock.now_utc()
    if is_wrong(context, schedule, now_utc, last):
        return last  # the gap is as long as the clock will say once it is right
    next_slot = schedule.next_slot(now_utc, last)
    # A row taken by hand may lie after the last slot that the daemon finished.
    missed = schedule.missed_between(min(last, finished or last), next_slot)
    if missed is None:
        return last
    count = context.store.record_gap(
        missed.first_utc, missed.last_utc, cause, detail, period_s=schedule.period_s
    )
    if count:
        _log.warning(
            "gap_recorded",
            first=slot_text(missed.first_utc),
            last=slot_text(missed.last_utc),
            slots=count,
            cause=cause.value,
            detail=detail,
        )
    return max(last, missed.last_utc)


def measure_orphans(context: SlotContext, since: datetime) -> int:
    """Measure the stored pairs without a row, each recorded under its own slot; give how many.

    A row that the database refuses stays an orphan. Raises StoreError when it cannot be read.
    """
    late = 0
    known = context.store.measured_slots(since) | finish_moves(context, since)
    for slot_utc in context.archive.orphans(known, since):
        try:
            record_late(context, slot_utc)
        except StoreError as error:
            _log.error("late_row_refused", slot=slot_text(slot_utc), error=str(error))
            continue
        except Exception:  # noqa: BLE001 - one pair must not keep every start from its slots
            _log.exception("late_row_broke", slot=slot_text(slot_utc))
            continue
        late += 1
    return late


def mark_start(context: SlotContext, schedule: Schedule, cause: GapCause, detail: str) -> None:
    """Note that a daemon runs: from now on its absence is a crash or a loss of power.

    Why there was none before this boot is noted once for each boot. Raises StoreError.
    """
    accounted = context.store.accounted()
    now_utc = context.clock.now_utc()
    # A slot that is due just now is still to be taken.
    now_utc = min(now_utc, schedule.next_slot(now_utc, None) - SECOND)
    wrong = accounted is not None and is_wrong(context, schedule, now_utc, accounted[1])
    # A clock that woke elsewhere must not move the beginning of the next gap there.
    finished_utc = now_utc
    if accounted is not None:
        finished_utc = accounted[1] if wrong else max(now_utc, accounted[1])
    marks: dict[Mark, str | None] = {
        Mark.HEARTBEAT_UTC: instant_text(finished_utc),
        Mark.BOOT_ID: context.machine.boot_id,
        Mark.CLEAN_STOP_UTC: None,
    }
    before = read_absence(context.store)
    if before is None or before.boot_id != context.machine.boot_id:
        absence = Absence(cause, detail, context.machine.boot_id, is_open=wrong)
        marks[Mark.ABSENCE] = absence_text(absence)
    context.store.set_marks(marks)


def is_wrong(
    context: SlotContext, schedule: Schedule, now_utc: datetime, last_utc: datetime
) -> bool:
    """Tell whether the wall clock contradicts the last slot: before it, or years past it."""
    return schedule.is_behind(now_utc, last_utc) or (
        schedule.is_far_ahead(now_utc, last_utc) and not context.machine.clock_synchronised()
    )


def mark_finished(store: Store, time_utc: datetime) -> None:
    """Note up to when every slot has its row or gap."""
    store.set_mark(Mark.HEARTBEAT_UTC, instant_text(time_utc))


def mark_stop(store: Store, now_utc: datetime) -> None:
    """Note that the daemon ended as it was asked to."""
    store.set_mark(Mark.CLEAN_STOP_UTC, instant_text(now_utc))


def _mark_time(store: Store, mark: Mark) -> datetime | None:
    text = store.get_mark(mark)
    return None if text is None else datetime.fromisoformat(text)
