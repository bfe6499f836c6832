"""The slot loop: waits for a slot, runs it, accounts for it, and never dies of what it meets."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import structlog

from core.results import Reason
from daemon.clock.downtime import absence_text, read_absence
from daemon.control.camera_lease import CameraLease
from daemon.errors import DatabaseDamagedError, StoreError
from daemon.schedule import MissedSlots, Schedule
from daemon.slots.measuring_again import MeasuringAgain
from daemon.slots.pipeline import Missed, SlotContext, record_late, run_slot
from daemon.slots.recovery import is_wrong, mark_finished
from daemon.slots.reporting import Reporter
from daemon.slots.supervision import INTERNAL, Circuit
from daemon.slots.time_correction import Redated, put_right, split_at, undated_archive
from daemon.store.records import GapCause, Mark, MeasurementRecord
from daemon.text import span_text
from daemon.times import slot_text
from drivers.protocols import FramePairSource

_log = structlog.get_logger("dcam.daemon")

FIRST_IMPOSSIBLE_YEAR = 2100
"""A clock that says so is wrong, like one before the last slot: pairs wait for their true slots."""


@dataclass(frozen=True, slots=True)
class _Owed:
    """A gap that is to be recorded as soon as the database takes it."""

    missed: MissedSlots
    cause: GapCause
    detail: str


class SlotRunner:
    """Runs slot after slot on the clock of its pipeline, real or stepped."""

    def __init__(
        self,
        context: SlotContext,
        schedule: Schedule,
        source: FramePairSource,
        stop: threading.Event,
        last_utc: datetime | None,
        reporter: Reporter,
        lease: CameraLease | None = None,
        circuit: Circuit | None = None,
    ) -> None:
        self._context = context
        self._schedule = schedule
        self._source = source
        self._stop = stop
        self._reporter = reporter
        self._lease = lease or CameraLease(source.close)
        self._circuit = circuit or Circuit()
        self._last = last_utc
        """The last slot that is accounted for, or owed."""
        self._owed: deque[_Owed] = deque()
        self._seen = self._look_at_clocks()
        self._clock_trouble = ""
        """What was wrong with the wall clock since the last slot."""
        self._failing: GapCause | None = None
        """Why the slot before had no row."""
        self._absence = read_absence(context.store)
        """Why there was no daemon before this boot, and whether its gap is recorded."""
        self._apart: SlotContext | None = None
        """What pairs pass through while the clock is wrong."""
        self._begun_s = -float(schedule.period_s)
        """Monotonic time at which the last slot began."""
        self._ended_utc: datetime | None = None
        """When the work of the last slot had ended."""
        self._last_undated: datetime | None = None
        """The last slot of the wrong clock, since it was stepped."""
        self._measuring_again = MeasuringAgain(context, stop)
        self._was_right: bool | None = None
        """Whether the clock was disciplined when last looked at."""

    def run(self, max_slots: int | None = None) -> int:
        """Run until asked to stop, or until so many slots have been run; give how many were.

        Raises ProcessSpentError when only a fresh process may help, DatabaseDamagedError.
        """
        done = 0
        while not self._stop.is_set() and (max_slots is None or done < max_slots):
            self._require_sound()
            slot = self._next_slot()
            self._settle_debts()
            far_s = (slot - self._seen[0]).total_seconds()
            self._context.readings.ahead(slot, far_s)
            if not self._context.clock.wait_until(slot, self._stop, far_s):
                break
            self._watch_clock()
            now_utc = self._read_clock()
            if now_utc < slot or self._schedule.is_too_late(slot, now_utc):
                continue  # the clock was stepped, back or forth
            self._begun_s = self._context.clock.monotonic_s()
            if self._is_wrong(now_utc):
                self._run_undated(slot)
            else:
                self._run(slot)
            self._use_the_rest(slot)
            self._ended_utc = self._context.clock.now_utc()
            done += 1
        self._settle_debts()
        self._require_sound()
        return done

    def _require_sound(self) -> None:
        """End the daemon over a damaged database: only a start can set it aside."""
        if self._context.store.damage is not None:
            raise self._context.store.damage

    def _next_slot(self) -> datetime:
        """Choose the next slot; those that have gone by unused become a gap."""
        self._watch_clock()
        now_utc = self._read_clock()
        if self._is_wrong(now_utc):
            # Half a period from the pair before, or both would be nearest to one true slot.
            passed_s = self._context.clock.monotonic_s() - self._begun_s
            rest_s = max(self._schedule.period_s / 2 - passed_s, 0.0)
            return self._schedule.next_slot(now_utc + timedelta(seconds=rest_s), self._last_undated)
        slot = self._schedule.next_slot(now_utc, self._last)
        missed = self._schedule.missed_between(self._last, slot) if self._last else None
        if missed is not None:
            if self._clock_trouble:
                self._owe_to_clock(missed)
            else:
                self._owe(missed, GapCause.OVERRUN, self._why_overrun(missed, now_utc))
        return slot

    def _why_overrun(self, missed: MissedSlots, now_utc: datetime) -> str:
        """The slot before, or a process that got no time: stopped, or on an overloaded computer."""
        ended_utc = self._ended_utc
        if ended_utc is None or self._schedule.is_too_late(missed.first_utc, ended_utc):
            return "the slot before took too long"
        held_s = (now_utc - max(ended_utc, missed.first_utc)).total_seconds()
        return (
            f"dcamd was held up for {span_text(held_s)}: it was stopped, or the computer was "
            "overloaded"
        )

    def _use_the_rest(self, slot: datetime) -> None:
        """Make room and measure again what waits for it, as long as that delays no slot."""
        slot_s = self._context.clock.monotonic_s() - self._begun_s
        if (room_s := self._room_s()) is not None:
            self._context.disk.tend(slot, room_s)
        if (room_s := self._room_s()) is not None:
            self._measuring_again.tend(room_s, slot_s)

    def _room_s(self) -> float | None:
        """The time to the next slot; None while the clock is wrong."""
        now_utc = self._context.clock.now_utc()
        if self._is_wrong(now_utc):
            return None
        return (self._schedule.next_slot(now_utc, self._last) - now_utc).total_seconds()

    def _owe_to_clock(self, missed: MissedSlots) -> None:
        """The clock was wrong since this boot; what was missed before it has a cause of its own."""
        context = self._context
        booted_utc = context.clock.now_utc() - timedelta(seconds=context.machine.uptime_s())
        absence, trouble = self._absence, self._clock_trouble or "the clock was wrong"
        if absence is None or not absence.is_open:
            self._owe(missed, GapCause.CLOCK_WRONG, trouble)
            return
        for part, cause, detail in split_at(self._schedule, missed, booted_utc, absence):
            is_clock = cause is GapCause.CLOCK_WRONG
            self._owe(part, cause, trouble if is_clock else detail)

    def _run(self, slot: datetime) -> None:
        with self._lease.slot(slot) as reason:
            if reason is None:
                outcome = run_slot(self._context, slot, self._source)
            else:
                outcome = Missed(slot, GapCause.CALIBRATION, reason)
        self._clock_trouble = ""
        if isinstance(outcome, Missed):
            self._owe(MissedSlots(slot, slot, 1), outcome.cause, outcome.detail)
        else:
            self._last = slot
        self._settle_debts()
        self._mark_finished(slot, outcome)
        self._end_slot(slot, outcome)

    def _run_undated(self, slot: datetime) -> None:
        """Keep a pair whose slot nobody knows yet: the time since the boot will tell.

        The record ends with the last slot all the same: neither a gap nor a mark comes of it.
        """
        if self._apart is None:
            name = f"{self._context.machine.boot_id[:8]}-{self._context.machine.uptime_s():.0f}"
            archive = undated_archive(self._context, name)
            self._apart = replace(self._context, archive=archive, undated=True)
        with self._lease.slot(slot) as reason:
            if reason is None:
                outcome = run_slot(self._apart, slot, self._source)
            else:
                outcome = Missed(slot, GapCause.CALIBRATION, reason)
        self._last_undated = slot
        try:
            if self._failing is not GapCause.CLOCK_WRONG:
                self._note_change(slot, GapCause.CLOCK_WRONG)
        except StoreError as error:
            _log.error("event_not_recorded", error=str(error))
        self._end_slot(slot, outcome)

    def _end_slot(self, slot: datetime, outcome: MeasurementRecord | Missed) -> None:
        """A cycle has ended: say so, and whether the next one makes sense in this process."""
        self._reporter.slot_done(slot, outcome)
        if isinstance(outcome, Missed):
            self._circuit.slot_ended(outcome.policy, outcome.detail)
        elif Reason.INTERNAL_ERROR in outcome.measurement.reasons:
            self._circuit.slot_ended(INTERNAL, Reason.INTERNAL_ERROR)
        else:
            self._circuit.slot_ended(None)

    def _owe(self, missed: MissedSlots, cause: GapCause, detail: str) -> None:
        self._owed.append(_Owed(missed, cause, detail))
        self._last = missed.last_utc

    def _settle_debts(self) -> None:
        """Record the gaps that are owed; a pair kept without its row is measured instead."""
        while self._owed:
            owed = self._owed[0]
            try:
                self._settle(owed)
            except DatabaseDamagedError:
                raise
            except StoreError as error:
                _log.error("gap_not_recorded", cause=owed.cause.value, error=str(error))
                return
            self._owed.popleft()

    def _settle(self, owed: _Owed) -> None:
        context, missed = self._context, owed.missed
        until = missed.last_utc + timedelta(seconds=1)
        for slot in context.archive.orphans(
            context.store.measured_slots(missed.first_utc, until), missed.first_utc
        ):
            if slot < until:
                record_late(context, slot)
        context.store.record_gap(
            missed.first_utc,
            missed.last_utc,
            owed.cause,
            owed.detail,
            period_s=self._schedule.period_s,
        )

    def _mark_finished(self, slot: datetime, outcome: MeasurementRecord | Missed) -> None:
        cause = outcome.cause if isinstance(outcome, Missed) else None
        if self._owed:
            return
        try:
            mark_finished(self._context.store, slot)
            if self._absence is not None and self._absence.is_open:
                self._absence = replace(self._absence, is_open=False)
                self._context.store.set_mark(Mark.ABSENCE, absence_text(self._absence))
            if cause != self._failing:
                self._note_change(slot, cause)
        except StoreError as error:
            _log.error("mark_not_set", error=str(error))

    def _note_change(self, slot: datetime, cause: GapCause | None) -> None:
        """Enter in the history when slots begin to fail, for which cause, and when that ends."""
        kind = cause.value if cause else "slots_again"
        self._context.store.add_event(
            self._context.clock.now_utc(), kind, f"slot {slot_text(slot)}"
        )
        self._failing = cause

    def _look_at_clocks(self) -> tuple[datetime, float]:
        return self._context.clock.now_utc(), self._context.clock.monotonic_s()

    def _is_wrong(self, now_utc: datetime) -> bool:
        """Whether slots may not be named by the clock."""
        if now_utc.year >= FIRST_IMPOSSIBLE_YEAR:
            return True  # no record begins there, and the calendar ends soon after
        last_utc = self._last
        return last_utc is not None and is_wrong(self._context, self._schedule, now_utc, last_utc)

    def _watch_clock(self) -> None:
        """Notice a wall clock that was stepped, that is before the last slot, or is right again."""
        utc = self._read_clock()
        if self._is_wrong(utc) and not self._clock_trouble:
            where = "before" if self._last is None or utc < self._last else "years past"
            self._note_clock(f"the clock said {utc:%Y-%m-%dT%H:%M:%SZ}, {where} the last slot")
        is_right = self._context.machine.clock_synchronised()
        if is_right and not self._was_right:
            self._put_right()
        self._was_right = is_right

    def _read_clock(self) -> datetime:
        """Give the time; a step since it was last read is noted before anything follows from it."""
        utc, monotonic_s = self._look_at_clocks()
        step_s = (utc - self._seen[0]).total_seconds() - (monotonic_s - self._seen[1])
        self._seen = utc, monotonic_s
        if abs(step_s) > self._schedule.max_late_s:
            slept = ", or the machine slept" if step_s > 0 else ""
            self._note_clock(f"the clock was stepped by {step_s:+.0f} s{slept}")
            self._apart = self._last_undated = self._was_right = None
        return utc

    def _put_right(self) -> None:
        """Date what this boot took while the clock was wrong: it is right now."""
        try:
            if put_right(self._context, self._schedule) == Redated():
                return
            accounted = self._context.store.accounted()
        except StoreError as error:
            _log.error("times_not_put_right", error=str(error))
            return
        before_utc, self._last = self._last, accounted[1] if accounted else None
        if before_utc is None or self._last is None:
            return
        missed = self._schedule.missed_between(before_utc, self._last)
        if missed is not None:
            last_utc = self._last
            self._owe_to_clock(missed)
            self._last = last_utc

    def _note_clock(self, trouble: str) -> None:
        _log.warning("clock_wrong", detail=trouble)
        if not self._clock_trouble:
            self._clock_trouble = trouble
