"""For how long the room lasts, the rules of retention considered: plain arithmetic."""

from __future__ import annotations

from dataclasses import dataclass

from daemon.retention.rules import Rules
from daemon.store.records import Thinning

FOR_EVER_DAYS = 36_500
"""Longer than this nobody asks."""


@dataclass(frozen=True, slots=True)
class Archive:
    """What the frames take, as last counted."""

    days: int
    bytes: int


def days_until_short(
    rules: Rules, archive: Archive, day_bytes: float, slots_a_day: float, free_bytes: float
) -> float | None:
    """Days until frames must be thinned sooner than their age says; None: that never comes.

    `day_bytes` is a whole day of frames. 0 where it has come already.
    """
    room = min(free_bytes - rules.min_free_bytes, rules.max_bytes - archive.bytes)
    if room <= 0:
        return 0.0
    now = _planned(rules, archive.days, slots_a_day)
    low, high = 0.0, float(FOR_EVER_DAYS)
    if (_planned(rules, archive.days + high, slots_a_day) - now) * day_bytes < room:
        return None
    while high - low > 0.01:  # the size grows with time, so that it is halved
        middle = (low + high) / 2
        grown = (_planned(rules, archive.days + middle, slots_a_day) - now) * day_bytes
        low, high = (low, middle) if grown >= room else (middle, high)
    return high


def _planned(rules: Rules, days: float, slots_a_day: float) -> float:
    """Whole days of frames that are kept of so many days."""
    total, before = 0.0, 0.0
    shares = (
        (Thinning.EVERY_SLOT, 1.0),
        (Thinning.HOURLY, min(1.0, 24.0 / slots_a_day)),
        (Thinning.DAILY, min(1.0, 1.0 / slots_a_day)),
    )
    for level, share in shares:
        until = max(before, min(days, rules.limit_days(level)))
        total += share * (until - before)
        before = until
    return total
