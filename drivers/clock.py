"""Clocks: the machine's own, and one that is stepped by whoever waits for it."""

from __future__ import annotations

import math
import threading
import time
from datetime import UTC, datetime, timedelta

SLICE_S = 1.0
"""Longest single sleep: how soon a stepped wall clock is noticed."""


class SystemClock:
    """The machine's clock: UTC as the operating system has it, and its monotonic clock."""

    def now_utc(self) -> datetime:
        """Give the present, timezone-aware UTC."""
        return datetime.now(UTC)

    def monotonic_s(self) -> float:
        """Give seconds that never step."""
        return time.monotonic()

    def pause(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(max(seconds, 0.0))

    def wait_until(
        self, when_utc: datetime, stop: threading.Event, longest_s: float = math.inf
    ) -> bool:
        """Wait for a wall-clock time; False if `stop` was set before.

        The wall clock is read again every `SLICE_S`, because NTP or an operator may step it while
        we sleep: after a step forward the wait ends within a slice. It takes no more than a slice
        longer than by the clock as it was at first: after a step back the time is not reached.
        Whoever chose the time by an earlier look at the clock gives how far it was then.
        """
        planned_s = (when_utc - self.now_utc()).total_seconds()
        end_s = self.monotonic_s() + min(planned_s, longest_s) + SLICE_S
        while not stop.is_set():
            left_s = (when_utc - self.now_utc()).total_seconds()
            if left_s <= 0.0 or self.monotonic_s() > end_s:
                return True
            stop.wait(min(left_s, SLICE_S))
        return False


class SteppedClock:
    """A clock that stands still and jumps to whatever time is waited for.

    The simulated rig and the tests run on it, faster than real time. Thread-safe.
    """

    def __init__(self, start_utc: datetime) -> None:
        if start_utc.utcoffset() is None:
            msg = f"a clock needs a timezone-aware start, got {start_utc.isoformat()}"
            raise ValueError(msg)
        self._lock = threading.Lock()
        self._now = start_utc.astimezone(UTC)
        self._monotonic_s = 0.0

    def now_utc(self) -> datetime:
        """Give the time that was last waited for or set."""
        with self._lock:
            return self._now

    def monotonic_s(self) -> float:
        """Give the seconds waited and advanced since the start; never steps back."""
        with self._lock:
            return self._monotonic_s

    def pause(self, seconds: float) -> None:
        """Be so much later at once."""
        self.advance(max(seconds, 0.0))

    def wait_until(
        self, when_utc: datetime, stop: threading.Event, longest_s: float = math.inf
    ) -> bool:
        """Be at that time at once; False if `stop` is set. A time in the past changes nothing."""
        if stop.is_set():
            return False
        with self._lock:
            planned_s = (when_utc - self._now).total_seconds()
            late_s = planned_s - longest_s - SLICE_S
            self._go_to(when_utc - timedelta(seconds=late_s) if late_s > 0.0 else when_utc)
        return True

    def advance(self, seconds: float) -> None:
        """Let time pass on both clocks."""
        if seconds < 0.0:
            msg = f"time passes forwards only, got {seconds} s; use set_utc to step the wall clock"
            raise ValueError(msg)
        with self._lock:
            self._go_to(self._now + timedelta(seconds=seconds))

    def set_utc(self, when_utc: datetime) -> None:
        """Step the wall clock, forwards or back, as NTP does; monotonic time stays."""
        with self._lock:
            self._now = when_utc.astimezone(UTC)

    def _go_to(self, when_utc: datetime) -> None:
        passed_s = (when_utc - self._now).total_seconds()
        if passed_s > 0.0:
            self._now = when_utc.astimezone(UTC)
            self._monotonic_s += passed_s
