"""The slots: a grid on the wall clock, in UTC, that is the same after every restart."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import cast

from apscheduler.triggers.interval import IntervalTrigger

from daemon.times import EPOCH

SECOND = timedelta(seconds=1)


@dataclass(frozen=True, slots=True)
class MissedSlots:
    """A run of slots without a row, first and last included."""

    first_utc: datetime
    last_utc: datetime
    count: int


FARTHEST_AHEAD = timedelta(days=1000)
"""Past the last slot: a site may be without power for a winter, or two."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Slots at `offset_s + k * period_s` since the epoch, UTC, whole seconds.

    On this grid a period that divides a day gives the same times every day, and neither a
    restart nor a change of local time moves a slot.
    """

    period_s: int
    offset_s: int = 0
    max_late_s: float = 2.0
    """A slot that cannot be taken within this time of its name is missed."""

    def first_from(self, when_utc: datetime) -> datetime:
        """Give the first slot at or after a time."""
        trigger = IntervalTrigger(
            seconds=self.period_s, start_date=EPOCH + self.offset_s * SECOND, timezone=UTC
        )
        whole = when_utc.replace(microsecond=0)
        start = whole if whole == when_utc else whole + SECOND
        return cast("datetime", trigger.get_next_fire_time(None, start))

    def first_after(self, when_utc: datetime) -> datetime:
        """Give the first slot later than a time."""
        return self.first_from(when_utc.replace(microsecond=0) + SECOND)

    def next_slot(self, now_utc: datetime, last_utc: datetime | None) -> datetime:
        """Give the slot to take next: never one at or before `last_utc`, whatever the clock says.

        A slot whose time has just passed is still taken if it is not later than `max_late_s`.
        """
        earliest = self.first_from(now_utc - timedelta(seconds=self.max_late_s))
        return earliest if last_utc is None else max(earliest, self.first_after(last_utc))

    def nearest(self, when_utc: datetime) -> datetime:
        """Give the slot that a time is nearest to."""
        return self.first_from(when_utc - timedelta(seconds=self.period_s / 2))

    def last_due(self, now_utc: datetime) -> datetime:
        """Give the latest slot that is not in the future."""
        return self.first_after(now_utc) - self.period_s * SECOND

    def is_behind(self, now_utc: datetime, last_utc: datetime) -> bool:
        """Tell whether a clock is so far before the last slot that slots would be lost to it."""
        return now_utc < last_utc - self.period_s * SECOND

    @staticmethod
    def is_far_ahead(now_utc: datetime, last_utc: datetime) -> bool:
        """Tell whether a clock that nothing disciplines is too far past the last slot.

        No computer is without power for so long; a battery clock that lost its year is common.
        """
        return now_utc > last_utc + FARTHEST_AHEAD

    def is_too_late(self, slot_utc: datetime, now_utc: datetime) -> bool:
        """Tell whether a slot can no longer be taken under its name."""
        return now_utc - slot_utc > timedelta(seconds=self.max_late_s)

    def missed_between(self, after_utc: datetime, before_utc: datetime) -> MissedSlots | None:
        """Give the slots strictly between two times, None if there are none."""
        first = self.first_after(after_utc)
        if first >= before_utc:
            return None
        step = self.period_s * SECOND
        # The last slot before: one whole step less if `before_utc` is itself a slot.
        count = -((first - before_utc) // step)
        return MissedSlots(first_utc=first, last_utc=first + (count - 1) * step, count=count)
