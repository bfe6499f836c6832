"""What is kept of the frames, and what goes first when room runs short: plain rules, no disk.

Days are counted where frames were taken: the age of a day is the number of later days with
frames. Neither a clock that jumps by years nor a station that was off for a year ages anything.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import groupby

from daemon.store.records import FrameDay, Thinning

NEWEST = timedelta(hours=1)
"""Before the last slot: of this time nothing is removed, whatever happens."""

_GIGABYTE, _MEGABYTE = 1e9, 1e6


@dataclass(frozen=True, slots=True)
class Rules:
    """`[retention]`."""

    every_slot_days: int = 30
    hourly_days: int = 365
    frames_days: int | None = None
    """None: for ever."""
    frames_max_gb: float | None = None
    min_free_gb: float = 5.0
    reserve_mb: int = 64

    @property
    def max_bytes(self) -> float:
        """What the frames may take, infinite without a limit."""
        return math.inf if self.frames_max_gb is None else self.frames_max_gb * _GIGABYTE

    @property
    def min_free_bytes(self) -> float:
        """Below this much free space frames go sooner than their time."""
        return max(self.min_free_gb * _GIGABYTE, 2.0 * self.reserve_bytes)

    @property
    def reserve_bytes(self) -> int:
        """The size of the reserve file."""
        return int(self.reserve_mb * _MEGABYTE)

    def limit_days(self, level: Thinning) -> float:
        """Up to which age a day may stay at a level; infinite: for ever."""
        last = math.inf if self.frames_days is None else float(self.frames_days)
        if level is Thinning.EVERY_SLOT:
            return min(self.every_slot_days, last)
        if level is Thinning.HOURLY:
            return min(max(self.hourly_days, self.every_slot_days), last)
        return last if level is Thinning.DAILY else math.inf

    def level_due(self, age_days: int) -> Thinning:
        """The level of a day by its age, if there is room."""
        steps = (Thinning.EVERY_SLOT, Thinning.HOURLY, Thinning.DAILY)
        return next((at for at in steps if age_days < self.limit_days(at)), Thinning.EVENTS)

    def first_to_go(self, days: Sequence[FrameDay]) -> FrameDay | None:
        """The day to thin next where room is short: all the terms shrink in proportion.

        `days` are in order, and none of them is the newest. None when only what is always kept
        is left.
        """
        open_days = [
            (age, day)
            for age, day in enumerate(reversed(days), 1)
            if day.level not in {Thinning.EVENTS, Thinning.NOTHING}
        ]
        if not open_days:
            return None
        return max(open_days, key=lambda one: (one[0] / self.limit_days(one[1].level), one[0]))[1]


def chosen(
    rows: Mapping[datetime, str], level: Thinning, always: Collection[datetime]
) -> set[datetime]:
    """Which of a day's slots (slot to reasons, `""` if good) stay at a level.

    Of an hour, or of the day, that is the middle one of the good ones: a daily frame is one of
    broad daylight wherever the station stands. At NOTHING what is always kept goes as well.
    """
    if level is Thinning.NOTHING:
        return set()
    slots = sorted(rows)
    kept = {slot for slot in slots if slot in always}
    if level is Thinning.EVERY_SLOT:
        kept.update(slots)
    elif level is Thinning.HOURLY:
        hours = groupby(slots, key=lambda slot: slot.hour)
        kept.update(_typical(list(group), rows) for _, group in hours)
    elif level is Thinning.DAILY and slots:
        kept.add(_typical(slots, rows))
    return kept


def _typical(slots: list[datetime], rows: Mapping[datetime, str]) -> datetime:
    good = [slot for slot in slots if not rows[slot]] or slots
    return good[len(good) // 2]
