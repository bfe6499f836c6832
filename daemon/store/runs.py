"""Runs of slots: a `range` of Unix seconds with the period as its step.

Membership, length and overlap are then the language's own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from datetime import datetime, timedelta
from itertools import pairwise

from daemon.times import EPOCH


def unix_s(slot_utc: datetime) -> int:
    """Whole Unix seconds of a slot."""
    return (slot_utc - EPOCH) // timedelta(seconds=1)


def slot_at(unix: int) -> datetime:
    """The slot of whole Unix seconds."""
    return EPOCH + timedelta(seconds=unix)


def next_second(time_utc: datetime) -> datetime:
    """The first whole second from a moment on; as a limit it parts slots just as the moment."""
    if not time_utc.microsecond:
        return time_utc
    return time_utc.replace(microsecond=0) + timedelta(seconds=1)


def run_between(first: datetime, last: datetime, period_s: int) -> range:
    """The slots from `first` to `last`, both included.

    Raises ValueError unless they lie a whole number of periods apart, in this order.
    """
    start, end = unix_s(first), unix_s(last)
    if period_s < 1 or end < start or (end - start) % period_s:
        msg = f"{first} to {last} is not a run of slots {period_s} s apart"
        raise ValueError(msg)
    return range(start, end + period_s, period_s)


def without(slots: range, taken: Collection[int]) -> Iterator[range]:
    """The runs that are left of `slots` when the taken ones go, in order."""
    borders = [slots.start - slots.step, *sorted(t for t in taken if t in slots), slots.stop]
    for before, after in pairwise(borders):
        run = range(before + slots.step, after, slots.step)
        if run:
            yield run


def overlap(one: range, other: range) -> int:
    """How many slots two runs share."""
    if one.step == other.step and (one.start - other.start) % one.step == 0:
        common = range(max(one.start, other.start), min(one.stop, other.stop), one.step)
        return len(common)
    shorter, longer = sorted((one, other), key=len)
    return sum(slot in longer for slot in shorter)


def schedule_slots(since: datetime, until: datetime, period_s: int, offset_s: int = 0) -> range:
    """Unix seconds of the slots `k * period + offset` with since <= slot < until."""
    if period_s < 1:
        msg = f"not a period: {period_s} s"
        raise ValueError(msg)
    start = unix_s(next_second(since))
    first = start + (offset_s - start) % period_s
    return range(first, max(first, unix_s(next_second(until))), period_s)
