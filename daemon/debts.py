"""Slots that the database did not take: gaps owed, and pairs to be measured late.

Bounded whatever happens: a disk may refuse for months, and the daemon goes on.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import structlog

from daemon.pipeline import Pipeline, record_late
from daemon.schedule import MissedSlots, Schedule
from daemon.store.errors import (
    DatabaseBusyError,
    DatabaseDamagedError,
    DatabaseUnwritableError,
    DiskFullError,
    StoreError,
)
from daemon.store.records import GapCause
from daemon.store.times import slot_text

_log = structlog.get_logger("dcam.daemon")

MOST_OWED = 1000
"""Gaps with causes of their own; further slots are added to the last one."""
LATE_AT_ONCE = 20
"""Pairs measured late between two slots: the next slot is not to wait for a day of them."""

_FOR_NOW = (DatabaseBusyError, DatabaseUnwritableError, DiskFullError)
"""Refusals of everything; any other is of one row."""


@dataclass(frozen=True, slots=True)
class _Owed:
    missed: MissedSlots
    cause: GapCause
    detail: str


class Debts:
    """What is to be recorded as soon as the database takes it."""

    def __init__(self, line: Pipeline, schedule: Schedule) -> None:
        self._line = line
        self._schedule = schedule
        self._owed: deque[_Owed] = deque()
        self._late: deque[datetime] = deque()
        """Slots in gaps whose pairs were kept."""
        self._told: GapCause | None = None
        """The cause that was last said to be owed."""

    @property
    def are_settled(self) -> bool:
        """Whether every slot has its row or gap."""
        return not self._owed

    def owe(self, missed: MissedSlots, cause: GapCause, detail: str) -> None:
        """Note slots without a row; those that continue a gap that is owed are added to it."""
        last = self._owed[-1] if self._owed else None
        if last is not None and self._continues(last, missed, cause):
            both = MissedSlots(
                last.missed.first_utc, missed.last_utc, last.missed.count + missed.count
            )
            self._owed[-1] = replace(last, missed=both)
        else:
            self._owed.append(_Owed(missed, cause, detail))

    def _continues(self, last: _Owed, missed: MissedSlots, cause: GapCause) -> bool:
        alike = last.cause is cause or len(self._owed) >= MOST_OWED
        between = self._schedule.missed_between(last.missed.last_utc, missed.first_utc)
        return alike and between is None and last.missed.last_utc < missed.first_utc

    def settle(self) -> None:
        """Record the gaps that are owed; pairs kept without their rows are measured then.

        Raises DatabaseDamagedError.
        """
        try:
            while self._owed:
                self._record(self._owed[0])
                self._owed.popleft()
            self._measure_late()
        except DatabaseDamagedError:
            raise
        except StoreError as error:
            self._tell(error)
            return
        self._told = None

    def _tell(self, error: StoreError) -> None:
        """Say once that slots are owed, not at each of them."""
        cause = self._owed[0].cause if self._owed else GapCause.STORAGE_FAILED
        if cause is not self._told:
            _log.error("gap_not_recorded", cause=cause.value, error=str(error))
        self._told = cause

    def _record(self, owed: _Owed) -> None:
        line, missed = self._line, owed.missed
        line.store.record_gap(
            missed.first_utc,
            missed.last_utc,
            owed.cause,
            owed.detail,
            period_s=self._schedule.period_s,
        )
        until = missed.last_utc + timedelta(seconds=1)
        known = line.store.measured_slots(missed.first_utc, until)
        orphans = line.archive.orphans(known, missed.first_utc)
        self._late.extend(slot for slot in orphans if slot < until)

    def _measure_late(self) -> None:
        for _ in range(min(LATE_AT_ONCE, len(self._late))):
            slot = self._late[0]
            try:
                record_late(self._line, slot)
            except (*_FOR_NOW, DatabaseDamagedError):
                raise
            except StoreError as error:
                _log.error("late_row_refused", slot=slot_text(slot), error=str(error))
            self._late.popleft()
