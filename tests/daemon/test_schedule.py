"""Slots lie on a wall-clock grid; none is taken twice and none is forgotten."""

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.schedule import MissedSlots, Schedule
from daemon.times import EPOCH

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
MINUTELY = Schedule(period_s=60)


def at(seconds: float) -> datetime:
    """Seconds after noon."""
    return NOON + timedelta(seconds=seconds)


times = st.datetimes(
    min_value=datetime(2000, 1, 1),  # noqa: DTZ001 - hypothesis wants naive bounds
    max_value=datetime(2100, 1, 1),  # noqa: DTZ001 - as above
    timezones=st.just(UTC),
)
schedules = st.integers(1, 86_400).flatmap(
    lambda period: st.builds(
        Schedule,
        period_s=st.just(period),
        offset_s=st.integers(0, period - 1),
        max_late_s=st.floats(0.1, period),
    )
)


@given(schedules, times)
def test_slots_are_on_the_grid_and_the_first_is_the_nearest(schedule, when) -> None:
    slot = schedule.first_from(when)
    period = timedelta(seconds=schedule.period_s)
    assert when <= slot < when + period
    assert (slot - EPOCH) % period == timedelta(seconds=schedule.offset_s)
    assert slot < schedule.first_after(slot) == slot + period


@given(schedules, times, st.timedeltas(timedelta(0), timedelta(days=2)))
def test_missed_slots_are_those_strictly_between(schedule, after, span) -> None:
    missed = schedule.missed_between(after, after + span)
    expected = []
    slot = schedule.first_after(after)
    while slot < after + span and len(expected) < 50:
        expected.append(slot)
        slot = schedule.first_after(slot)
    if not expected:
        assert missed is None
    elif len(expected) < 50:
        assert missed == MissedSlots(expected[0], expected[-1], len(expected))
    else:
        assert missed is not None
        period = timedelta(seconds=schedule.period_s)
        assert missed.first_utc == expected[0]
        assert missed.last_utc == missed.first_utc + (missed.count - 1) * period
        assert missed.last_utc < after + span <= missed.last_utc + period


@given(schedules, times, st.timedeltas(timedelta(days=-400), timedelta(days=400)))
def test_no_slot_is_taken_twice_whatever_the_clock_does(schedule, now, step) -> None:
    last = schedule.next_slot(now, None)
    assert schedule.next_slot(now + step, last) > last


def test_slot_that_has_just_passed_is_still_taken_once() -> None:
    assert MINUTELY.next_slot(at(1.5), None) == at(0)
    assert MINUTELY.next_slot(at(1.5), last_utc=at(0)) == at(60)
    assert MINUTELY.next_slot(at(2.5), None) == at(60)


def test_lateness_is_counted_from_the_slot() -> None:
    assert not MINUTELY.is_too_late(at(0), at(2))
    assert MINUTELY.is_too_late(at(0), at(2.001))


def test_clock_in_the_past_waits_for_the_slot_after_the_last_row() -> None:
    assert MINUTELY.next_slot(NOON - timedelta(days=200), last_utc=NOON) == at(60)


@pytest.mark.parametrize("offset_s", [0, 7])
def test_daylight_saving_moves_nothing(offset_s: int) -> None:
    """Clocks in Europe go back at 01:00 UTC on this day; the grid does not notice."""
    hourly = Schedule(period_s=3600, offset_s=offset_s)
    slot = datetime(2026, 10, 25, 0, 0, offset_s, tzinfo=UTC)
    for hour in (1, 2, 3):
        slot = hourly.first_after(slot)
        assert slot == datetime(2026, 10, 25, hour, 0, offset_s, tzinfo=UTC)


def test_off_grid_row_of_a_hand_made_capture_does_not_shift_the_grid() -> None:
    assert MINUTELY.next_slot(at(20), last_utc=at(13)) == at(60)
    assert MINUTELY.missed_between(at(13), at(180)) == MissedSlots(at(60), at(120), 2)
