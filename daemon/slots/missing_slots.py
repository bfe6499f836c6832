"""Slots that a damaged database took with it: measured again where frames are left, else a gap."""

from __future__ import annotations

import structlog

from daemon.errors import StoreError
from daemon.schedule import Schedule
from daemon.slots.pipeline import SlotContext, record_late
from daemon.store.accounting import ScheduleEpoch, epochs_text, read_epochs, scheduled
from daemon.store.database import Store
from daemon.store.records import GapCause, Mark
from daemon.store.runs import slot_at, unix_s
from daemon.times import slot_text

_log = structlog.get_logger("dcam.daemon")


def note_schedule(store: Store, schedule: Schedule) -> None:
    """Note when the schedule became what it is: which slots there were is known by that alone.

    Raises StoreError.
    """
    epochs = read_epochs(store.get_mark(Mark.SCHEDULES))
    if epochs and (epochs[-1].period_s, epochs[-1].offset_s) == (
        schedule.period_s,
        schedule.offset_s,
    ):
        return
    accounted = store.accounted()
    after_utc = accounted[1] if accounted and epochs else None
    epochs.append(ScheduleEpoch(after_utc, schedule.period_s, schedule.offset_s))
    store.set_mark(Mark.SCHEDULES, epochs_text(epochs))


def account_for_lost(context: SlotContext) -> None:
    """After a salvage give every slot that lost its row or gap a late row, or a gap.

    May be cut off and done again. Raises StoreError.
    """
    store = context.store
    salvaged, accounted = store.get_mark(Mark.SALVAGED), store.accounted()
    if salvaged is None:
        return
    if accounted is not None:
        for slots in scheduled(read_epochs(store.get_mark(Mark.SCHEDULES)), *accounted):
            for hole in store.missing_slots(slots):
                _fill(context, hole, salvaged)
    store.set_mark(Mark.SALVAGED, None)


def _fill(context: SlotContext, hole: range, salvaged: str) -> None:
    first_utc, last_utc = slot_at(hole[0]), slot_at(hole[-1])
    late = 0
    for slot_utc in context.archive.stored_slots(first_utc, last_utc):
        if unix_s(slot_utc) in hole:
            try:
                record_late(context, slot_utc)
            except StoreError as error:
                _log.error("late_row_refused", slot=slot_text(slot_utc), error=str(error))
                continue
            late += 1
    missed = context.store.record_gap(
        first_utc, last_utc, GapCause.STORAGE_FAILED, salvaged, period_s=hole.step
    )
    _log.warning(
        "lost_slots_accounted_for",
        first=slot_text(first_utc),
        last=slot_text(last_utc),
        measured_again=late,
        in_gap=missed,
    )
