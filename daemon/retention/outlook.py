"""For how long the room lasts, the rules of retention considered: plain arithmetic."""

from __future__ import annotations

from collections.abc import Iterator
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
    if day_bytes <= 0.0:
        return None
    kept = sum(
        share * (min(end, archive.days) - begin)
        for begin, end, share in _terms(rules, slots_a_day)
        if archive.days > begin
    )
    allowed = kept + room / day_bytes
    for begin, end, share in _terms(rules, slots_a_day):
        if allowed <= share * (end - begin):
            days = begin + allowed / share - archive.days
            return days if days <= FOR_EVER_DAYS else None
        allowed -= share * (end - begin)
    return None


def _terms(rules: Rules, slots_a_day: float) -> Iterator[tuple[float, float, float]]:
    """From which age to which a day keeps which share of its frames: first to last."""
    begin = 0.0
    for level, share in (
        (Thinning.EVERY_SLOT, 1.0),
        (Thinning.HOURLY, min(1.0, 24.0 / slots_a_day)),
        (Thinning.DAILY, min(1.0, 1.0 / slots_a_day)),
    ):
        end = max(begin, rules.limit_days(level))
        yield begin, end, share
        begin = end
