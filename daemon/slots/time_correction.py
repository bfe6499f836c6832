"""Times put right: what was taken while the clock was wrong gets its true slot.

The seconds since the boot tell how long ago a pair was taken, whatever the wall clock said then.
Once something disciplines the clock (NTP, PTP), or an operator vouches for it, the true time of a
pair is now minus that. Each pair moves in a transaction of its own, after its frames; what was cut
off is done again. Its values are those of the wrong time until it is measured again:
`measuring_again`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path, PurePosixPath

import structlog

from daemon.clock.downtime import Absence, read_absence
from daemon.schedule import SECOND, MissedSlots, Schedule
from daemon.slots.pipeline import SlotContext
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive, StoredPair
from daemon.store.frames.moves import clear_pairs, link_pairs, remove_if_empty
from daemon.store.records import GapCause, Mark, MeasurementRecord
from daemon.times import slot_text

_log = structlog.get_logger("dcam.daemon")

CRYSTAL_PPM = 200.0
"""How far a free-running clock may drift, generously: a difference that this explains came little
by little, and says nothing of the time of an old row."""

UNDATED = "undated"
"""Directory below the state directory, of the frames that wait for their slots."""

TrueTime = Callable[[MeasurementRecord], datetime]
"""Gives the true time of a record's capture."""


@dataclass(frozen=True, slots=True)
class Redated:
    """What came of putting times right."""

    dated: int = 0
    """Undated pairs that have their slot now."""
    moved: int = 0
    """Rows that went from one slot to another."""
    left: int = 0
    """Pairs whose true slot has a row already: they stay undated, or become so."""


@dataclass(frozen=True, slots=True)
class Books:
    """What a time correction writes to."""

    store: Store
    state: Path
    schedule: Schedule
    unseen: int = 0
    """Rows that are just being measured, held against rows that move meanwhile: 1 beside dcamd."""

    @property
    def archive(self) -> FrameArchive:
        """Where the pairs of known slots are."""
        return FrameArchive(self.state)

    def link(
        self, source: FrameArchive, from_slot_utc: datetime, slot_utc: datetime, true_utc: datetime
    ) -> StoredPair | None:
        """Link a slot's pairs to their true place, which recovery leaves alone if we are cut off.

        Gives the first one's, None if there is none. Raises StoreError.
        """
        self.store.set_mark(Mark.MOVING_TO_UTC, slot_text(slot_utc))
        return link_pairs(source, from_slot_utc, self.archive, slot_utc, true_utc)


def undated_archive(context: SlotContext, name: str) -> FrameArchive:
    """Where the frames of one stretch with a wrong clock are kept."""
    return FrameArchive(context.archive.state / UNDATED / name)


def since_boot(context: SlotContext) -> TrueTime:
    """The true time of this boot's captures, as long as the clock is right now."""
    booted_utc = context.clock.now_utc() - timedelta(seconds=context.machine.uptime_s())
    return lambda record: booted_utc + timedelta(seconds=record.uptime_s or 0.0)


def put_right(context: SlotContext, schedule: Schedule) -> Redated:
    """Date what this boot took under a wrong clock. The clock must be right now.

    Undated pairs get their slots. Rows that were taken while nothing disciplined the clock move,
    if they are further off than the schedule allows and than a crystal drifts. A clock that is
    before what another boot, or a disciplined clock, has recorded is not right, whoever vouches
    for it. Raises StoreError.
    """
    true_utc, uptime_s = since_boot(context), context.machine.uptime_s()

    def is_off(record: MeasurementRecord) -> bool:
        drift_s = 1e-6 * CRYSTAL_PPM * (uptime_s - (record.uptime_s or 0.0))
        off_s = abs((true_utc(record) - record.slot_utc).total_seconds())
        return off_s > schedule.max_late_s + drift_s

    boot_id = context.machine.boot_id
    known_utc = context.store.last_slot_but(boot_id)
    if known_utc is not None and schedule.is_behind(context.clock.now_utc(), known_utc):
        _log.error("times_not_put_right", error=f"the clock is before {slot_text(known_utc)}")
        return Redated()
    rows = [row for row in context.store.unsynchronised_rows(boot_id) if is_off(row)]
    undated = context.store.undated(boot_id)
    if not rows and not undated:
        return Redated()
    books = Books(context.store, context.archive.state, schedule)
    done = redate(books, rows, undated, true_utc)
    now_utc = context.clock.now_utc()
    booted_utc = now_utc - timedelta(seconds=context.machine.uptime_s())
    account_for_moved(books, rows, true_utc, now_utc, booted_utc)
    detail = f"{done.dated} undated pairs dated, {done.moved} rows moved, {done.left} left"
    context.store.add_event(context.clock.now_utc(), "redated", detail)
    _log.warning("redated", dated=done.dated, moved=done.moved, left=done.left)
    return done


def redate(
    books: Books,
    rows: Sequence[MeasurementRecord],
    undated: Iterable[tuple[int, MeasurementRecord]],
    true_utc: TrueTime,
) -> Redated:
    """Give rows and undated pairs the slots nearest to their true times. Raises StoreError."""
    leaving, moved = {row.slot_utc for row in rows}, 0
    waiting: list[MeasurementRecord] = []
    blocked: list[MeasurementRecord] = []
    for row in rows:
        slot_utc = books.schedule.nearest(true_utc(row))
        may_move = slot_utc in leaving or books.store.measurement(slot_utc) is None
        (waiting if may_move else blocked).append(row)
    for row in blocked:  # first: the slot that it leaves may be another one's
        _set_aside(books, row)
    while waiting:  # a row may have to wait for the one in its place to go
        backwards = true_utc(waiting[0]) < waiting[0].slot_utc
        waiting.sort(key=lambda row: row.slot_utc, reverse=not backwards)
        refused = [row for row in waiting if not _move(books, row, true_utc(row))]
        moved += len(waiting) - len(refused)
        if len(refused) == len(waiting):
            break
        waiting = refused
    for row in waiting:
        _set_aside(books, row)
    blocked += waiting
    results = [_date(books, number, record, true_utc(record)) for number, record in undated]
    books.store.set_mark(Mark.MOVING_TO_UTC, None)
    return Redated(results.count(True), moved, len(blocked) + results.count(False))


def mend_undated(context: SlotContext) -> None:
    """After a crash: bring the archives of undated pairs in order. Raises StoreError."""
    for directory in sorted((context.archive.state / UNDATED).glob("*/")):
        FrameArchive(directory).repair()


def finish_moves(context: SlotContext, since: datetime) -> set[datetime]:
    """Clear the places of frames whose row has moved, where a cut kept that from being done.

    Gives the slots, from `since` on, whose frames belong to a row elsewhere. Raises StoreError.
    """
    moved = context.store.moved_from(since)
    left = moved - context.store.measured_slots(since)
    for slot_utc in left.intersection(context.archive.stored_slots(since)):
        clear_pairs(context.archive, slot_utc)
    moving = context.store.get_mark(Mark.MOVING_TO_UTC)
    return left | ({datetime.fromisoformat(moving)} if moving else set())


def account_for_moved(
    books: Books,
    rows: Sequence[MeasurementRecord],
    true_utc: TrueTime,
    now_utc: datetime,
    booted_utc: datetime | None = None,
) -> None:
    """Make the gaps fit rows that have moved: none in the future, and none of the old slots bare.

    Of a clock that was wrong from a boot on, `booted_utc` is when that truly was: what was missed
    before has the cause of the absence. Raises StoreError.
    """
    if not rows:
        return
    store, schedule = books.store, books.schedule
    due_utc = schedule.last_due(now_utc)
    store.cut_gaps_after(due_utc)
    slots = [row.slot_utc for row in rows]
    # A row may go to before the record's beginning.
    first_utc = min(*slots, *(schedule.nearest(true_utc(row)) for row in rows))
    end_utc = due_utc if booted_utc else min(due_utc, max(slots) + SECOND)
    missed = schedule.missed_between(first_utc - SECOND, end_utc)
    absence = read_absence(store)
    if missed is None:
        return
    parts = [(missed, GapCause.CLOCK_WRONG, "the clock was wrong")]
    if absence is not None and booted_utc is not None:
        parts = list(split_at(schedule, missed, booted_utc, absence))
    for part, cause, detail in parts:
        if cause is not GapCause.CLOCK_WRONG:
            store.change_cause(part.first_utc, part.last_utc, GapCause.CLOCK_WRONG, cause, detail)
        store.record_gap(part.first_utc, part.last_utc, cause, detail, period_s=schedule.period_s)


def split_at(
    schedule: Schedule, missed: MissedSlots, booted_utc: datetime, absence: Absence
) -> Iterator[tuple[MissedSlots, GapCause, str]]:
    """Part missed slots into those before a boot and those after, each with its cause."""
    before = schedule.missed_between(
        missed.first_utc - SECOND, min(booted_utc, missed.last_utc + SECOND)
    )
    if before is not None:
        yield before, absence.cause, absence.detail
    after = schedule.missed_between(
        before.last_utc if before else missed.first_utc - SECOND, missed.last_utc + SECOND
    )
    if after is not None:
        yield after, GapCause.CLOCK_WRONG, "the clock was wrong"


def _move(books: Books, row: MeasurementRecord, true_utc: datetime) -> bool:
    """Give a row its true slot; False while that has another one."""
    slot_utc, archive = books.schedule.nearest(true_utc), books.archive
    if slot_utc == row.slot_utc:
        return True
    if books.store.measurement(slot_utc) is not None:
        return False
    stored = books.link(archive, row.slot_utc, slot_utc, true_utc)
    books.store.move_row(
        row.slot_utc,
        replace(
            row,
            slot_utc=slot_utc,
            captured_utc=true_utc,
            main_frame=stored.main_path if stored else row.main_frame,
            sub_frame=stored.sub_path if stored else row.sub_frame,
            redated_from_utc=row.redated_from_utc or row.slot_utc,
        ),
        books.unseen,
    )
    if stored:
        clear_pairs(archive, row.slot_utc)
    return True


def _set_aside(books: Books, row: MeasurementRecord) -> None:
    """Take a row whose true slot has another one out of the record, where it would be a lie."""
    apart = FrameArchive(books.state / UNDATED / f"{str(row.boot_id)[:8]}-left")
    taken_utc = row.captured_utc or row.slot_utc
    stored = link_pairs(books.archive, row.slot_utc, apart, row.slot_utc, taken_utc)
    prefix = apart.state.relative_to(books.state).as_posix()
    books.store.undate(
        replace(
            row,
            main_frame=f"{prefix}/{stored.main_path}" if stored else None,
            sub_frame=f"{prefix}/{stored.sub_path}" if stored else None,
        ),
        books.unseen,
    )
    clear_pairs(books.archive, row.slot_utc)


def _date(books: Books, number: int, record: MeasurementRecord, true_utc: datetime) -> bool:
    """Give an undated pair its slot; False if that has another row."""
    slot_utc = books.schedule.nearest(true_utc)
    if books.store.measurement(slot_utc) is not None:
        return False
    source = _undated_archive(books, record)
    stored = None
    if source is not None:
        stored = books.link(source, record.slot_utc, slot_utc, true_utc)
    books.store.date(
        number,
        replace(
            record,
            slot_utc=slot_utc,
            captured_utc=true_utc,
            main_frame=stored.main_path if stored else None,
            sub_frame=stored.sub_path if stored else None,
            redated_from_utc=record.slot_utc,
            recorded_late=False,
        ),
    )
    if source is not None:
        clear_pairs(source, record.slot_utc)
        remove_if_empty(source)
    return True


def _undated_archive(books: Books, record: MeasurementRecord) -> FrameArchive | None:
    if record.main_frame is None:
        return None
    _, name, *_ = PurePosixPath(record.main_frame).parts
    return FrameArchive(books.state / UNDATED / name)
