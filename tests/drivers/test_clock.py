"""Clocks: a wait ends at its wall-clock time, even when that clock is stepped, or at `stop`."""

from __future__ import annotations

import threading
import time
from datetime import UTC, datetime, timedelta

import pytest

from drivers import clock as clock_module
from drivers.clock import SteppedClock, SystemClock

START = datetime(2026, 3, 1, tzinfo=UTC)


class _Wall(SystemClock):
    """A system clock whose wall time is scripted; counts how often it is read."""

    def __init__(self, times: list[datetime]) -> None:
        self.times = times
        self.reads = 0

    def now_utc(self) -> datetime:
        self.reads += 1
        return self.times.pop(0) if len(self.times) > 1 else self.times[0]


def test_system_clock_is_utc_and_monotonic() -> None:
    """now_utc is timezone-aware UTC; monotonic seconds are the host's."""
    clock = SystemClock()
    assert clock.now_utc().utcoffset() == timedelta(0)
    before_s = time.monotonic()
    assert before_s <= clock.monotonic_s() <= time.monotonic()


def test_past_time_returns_at_once() -> None:
    """Waiting for a time that has passed is no wait."""
    clock = SystemClock()
    assert clock.wait_until(clock.now_utc() - timedelta(hours=1), threading.Event())


def test_wait_reaches_its_time() -> None:
    """After a wait the wall clock has reached the time waited for."""
    clock = SystemClock()
    when = clock.now_utc() + timedelta(milliseconds=20)
    assert clock.wait_until(when, threading.Event())
    assert clock.now_utc() >= when


def test_step_forward_ends_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall clock stepped past the time is noticed within a slice, not after the hour."""
    monkeypatch.setattr(clock_module, "SLICE_S", 0.01)
    clock = _Wall([START, START, START + timedelta(hours=2)])
    assert clock.wait_until(START + timedelta(hours=1), threading.Event())
    assert clock.reads == 3


def test_step_back_ends_the_wait_as_if_there_was_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall clock stepped back by a day must not put whoever waits to sleep for a day."""
    monkeypatch.setattr(clock_module, "SLICE_S", 0.01)
    clock = _Wall([START, START, START - timedelta(days=1)])
    when = START + timedelta(milliseconds=50)
    assert clock.wait_until(when, threading.Event())
    assert clock.now_utc() < when


def test_a_step_back_just_before_the_wait_is_none_either(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time was chosen 50 ms ahead, and then the clock was stepped back by a day."""
    monkeypatch.setattr(clock_module, "SLICE_S", 0.01)
    clock = _Wall([START - timedelta(days=1)])
    assert clock.wait_until(START, threading.Event(), longest_s=0.05)
    assert clock.now_utc() < START


def test_stop_ends_the_wait() -> None:
    """A stop set before or during the wait gives False at once."""
    clock = SystemClock()
    stop = threading.Event()
    threading.Timer(0.02, stop.set).start()
    assert not clock.wait_until(clock.now_utc() + timedelta(hours=1), stop)
    assert not clock.wait_until(clock.now_utc() - timedelta(hours=1), stop)


def test_stepped_clock_jumps() -> None:
    """A stepped clock is at the time waited for at once, its monotonic time with it."""
    clock = SteppedClock(START)
    stop = threading.Event()
    assert clock.wait_until(START + timedelta(minutes=5), stop)
    assert clock.now_utc() == START + timedelta(minutes=5)
    assert clock.monotonic_s() == 300.0
    assert clock.wait_until(START, stop)
    assert clock.now_utc() == START + timedelta(minutes=5)
    clock.advance(1.5)
    assert clock.monotonic_s() == 301.5
    stop.set()
    assert not clock.wait_until(START + timedelta(hours=1), stop)
    assert clock.monotonic_s() == 301.5


def test_stepped_wall_leaves_monotonic_alone() -> None:
    """Stepping the wall clock back is seen in UTC and not in monotonic time."""
    clock = SteppedClock(START)
    clock.advance(10.0)
    clock.set_utc(START - timedelta(days=1))
    assert clock.now_utc() == START - timedelta(days=1)
    assert clock.monotonic_s() == 10.0


def test_stepped_clock_refuses_nonsense() -> None:
    """A naive start and time running backwards are programming errors."""
    with pytest.raises(ValueError, match="timezone-aware"):
        SteppedClock(datetime(2026, 3, 1))  # noqa: DTZ001 - the very mistake
    with pytest.raises(ValueError, match="forwards"):
        SteppedClock(START).advance(-1.0)
