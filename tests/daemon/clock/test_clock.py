"""A wrong clock cannot poison the record: no slot twice, none invented, times put right later."""

import os
from datetime import datetime, timedelta
from itertools import count

import pytest

from daemon.slots.recovery import recover
from daemon.slots.time_correction import put_right
from daemon.store.records import GapCause, Mark
from drivers.frameset import read_frame_set
from tests.daemon.times import minute_of, slot
from tests.exhaustive import one_of

WRONG = timedelta(days=900)
OUTAGE_S = 7_200


def set_clock(station, shift: timedelta):
    """What happens at a capture: somebody sets the clock."""
    return lambda: station.clock.set_utc(station.clock.now_utc() + shift)


def ntp(station, shift: timedelta):
    """What happens at a capture: NTP sets the clock, and disciplines it from then on."""

    def order() -> None:
        station.clock.set_utc(station.clock.now_utc() + shift)
        station.synchronised = True

    return order


def wake(station, off_by: timedelta) -> None:
    """The power fails after 12:01 and comes back at 14:01:30; the clock is off by so much then."""
    station.run(2)
    station.clock.advance(OUTAGE_S + 30)
    station.clock.set_utc(station.clock.now_utc() + off_by)
    station.synchronised = False


def frames_are_where_rows_say(station) -> None:
    """Each row's images are there, listed under its slot, and none is left over."""
    rows = list(station.store.measurements())
    for row in rows:
        assert (station.state / row.main_frame).is_file()
        assert (station.state / row.sub_frame).is_file()
    listed = {
        row.slot_utc
        for table in station.archive.directory.rglob("frames.csv")
        for row in read_frame_set(table.parent).rows
    }
    assert listed == {row.slot_utc for row in rows} == set(station.archive.stored_slots())


# ------------------------------------------------------------------ steps while it runs


def test_clock_stepped_forward_leaves_a_gap_that_says_so(station) -> None:
    station.run(3, {1: set_clock(station, timedelta(minutes=10))})
    assert station.minutes() == [0, 1, 11]
    assert station.gaps() == [(2, 10, "clock_wrong")]
    assert "stepped by +600 s" in station.store.gaps()[0].detail


def test_clock_stepped_back_overwrites_and_invents_nothing(station) -> None:
    """Pairs go on being taken; what nobody can date yet is kept apart."""
    station.run(4, {1: set_clock(station, -WRONG)})
    assert station.minutes() == [0, 1]
    assert station.gaps() == []
    undated = [record for _, record in station.store.undated()]
    assert [record.boot_id for record in undated] == ["boot-1", "boot-1"]
    assert [record.uptime_s for record in undated] == [150.0, 210.0]
    assert all((station.state / record.main_frame).is_file() for record in undated)


def stepped_after_look(make_station, number: int, shift: timedelta):
    """Four slots; the clock is stepped as soon as the daemon has looked at it so many times."""
    station = make_station()
    runner, clock, looks = station.start(), station.clock, count()
    look = clock.now_utc

    def look_and_step() -> datetime:
        seen = look()
        if next(looks) == number:
            clock.set_utc(seen + shift)
        return seen

    clock.now_utc = look_and_step
    begun_s = clock.monotonic_s()
    runner.run(4)
    assert next(looks) > number
    return station, clock.monotonic_s() - begun_s


@pytest.mark.parametrize("number", range(0, 20, one_of(3)))
def test_a_step_between_any_two_looks_at_the_clock_is_never_an_overrun(
    make_station, number: int
) -> None:
    station, _ = stepped_after_look(make_station, number, timedelta(days=1))
    assert {gap.cause for gap in station.store.gaps()} <= {GapCause.CLOCK_WRONG}


@pytest.mark.parametrize("number", range(0, 20, one_of(3)))
def test_a_step_back_between_any_two_looks_puts_nothing_to_sleep(make_station, number: int) -> None:
    station, lasted_s = stepped_after_look(make_station, number, timedelta(days=-1))
    assert lasted_s < 6 * 60
    assert {gap.cause for gap in station.store.gaps()} <= {GapCause.CLOCK_WRONG}


def test_a_step_back_of_less_than_a_period_waits_for_the_next_slot(station) -> None:
    station.run(4, {1: set_clock(station, timedelta(seconds=-40))})
    assert station.minutes() == [0, 1, 2, 3]
    assert station.store.undated() == []


def test_clock_that_comes_back_by_hand_leaves_a_gap_and_its_pairs_undated(station) -> None:
    """Nothing vouches for the clock: the pairs wait for an operator."""
    day = timedelta(days=1)
    orders = {1: set_clock(station, -day), 4: set_clock(station, day)}
    station.run(6, orders)
    assert station.minutes() == [0, 1, 4]
    assert station.gaps() == [(2, 3, "clock_wrong")]
    assert len(station.store.undated()) == 3


def test_pairs_of_a_wrong_clock_get_their_slots_once_it_is_disciplined(station) -> None:
    station.run(6, {1: set_clock(station, -WRONG), 4: ntp(station, WRONG)})
    assert station.minutes() == [0, 1, 2, 3, 4, 5]
    assert station.gaps() == []
    assert station.store.undated() == []
    row = station.store.measurement(slot(3))
    assert row.redated_from_utc == slot(3) - WRONG
    assert row.captured_utc == slot(3)
    assert row.clock_synchronised is None
    assert "3 undated pairs dated" in station.store.events(kind="redated")[0].detail
    frames_are_where_rows_say(station)
    assert not any((station.state / "undated").rglob("*.png"))


def test_rows_of_a_clock_that_was_ahead_go_back_to_their_slots(station) -> None:
    """An hour ahead for three slots, undisciplined; then NTP puts it right."""
    station.synchronised = False
    ahead = timedelta(hours=1, seconds=20)
    station.run(6, {1: set_clock(station, ahead), 4: ntp(station, -ahead)})
    assert station.minutes() == [0, 1, 2, 3, 4, 5]
    assert station.gaps() == []
    assert station.store.measurement(slot(3)).redated_from_utc == slot(63)
    frames_are_where_rows_say(station)


def test_rows_of_a_disciplined_clock_never_move(station) -> None:
    station.synchronised = True
    station.run(5, {1: ntp(station, timedelta(minutes=10)), 3: ntp(station, timedelta(minutes=9))})
    assert station.minutes() == [0, 1, 11, 12, 21]
    assert [row.redated_from_utc for row in station.store.measurements()] == [None] * 5


def test_a_disciplined_clock_before_the_record_is_not_believed(station) -> None:
    """A time server of its own that is wrong: nothing is dated after it, neither now nor later."""
    station.synchronised = True
    station.run(4, {1: ntp(station, -WRONG)})
    station.clock.advance(30)
    station.run(1)
    assert station.minutes() == [0, 1]
    assert len(station.store.undated()) == 3
    station.clock.advance(30)
    station.run(2, {0: ntp(station, WRONG)})
    assert station.store.undated() == []
    assert station.minutes() == [0, 1, 2, 3, 4, 5, 6]


def test_a_clock_that_drifted_for_weeks_leaves_old_rows_alone(station) -> None:
    """A minute in a month came little by little: the first rows were right."""
    station.synchronised = False
    station.run(3)
    station.clock.advance(30 * 86_400)
    station.run(2, {1: ntp(station, timedelta(seconds=60))})
    station.run(1)
    assert [row.redated_from_utc for row in station.store.measurements()][:3] == [None] * 3


# ------------------------------------------------------------------ waking with a wrong clock


TEN_YEARS = timedelta(days=3652)


def test_a_clock_ten_years_ahead_dates_no_row(station) -> None:
    """It would stand at the end of the record for ten years."""
    station.synchronised = False
    seen = []
    orders = {
        1: set_clock(station, TEN_YEARS),
        3: lambda: seen.append((station.minutes(), station.gaps())),
        4: ntp(station, -TEN_YEARS),
    }
    station.run(6, orders)
    assert seen == [([0, 1], [])]
    assert station.minutes() == [0, 1, 2, 3, 4, 5]
    assert (station.gaps(), station.store.undated()) == ([], [])
    frames_are_where_rows_say(station)


def test_wake_ten_years_ahead_then_ntp(station) -> None:
    wake(station, TEN_YEARS)
    station.run(5, {2: ntp(station, -TEN_YEARS)}, boot_id="boot-2")
    assert station.minutes() == [0, 1, 122, 123, 124, 125, 126]
    assert station.gaps() == [(2, 121, "power_loss")]
    assert station.store.undated() == []
    frames_are_where_rows_say(station)


def test_a_disciplined_clock_years_past_the_last_slot_is_believed(station) -> None:
    """A computer that lay in a cupboard."""
    wake(station, TEN_YEARS)
    station.synchronised = True
    station.run(2, boot_id="boot-2")
    assert len(station.minutes()) == 4
    assert [cause for *_, cause in station.gaps()] == ["power_loss"]


def test_wake_in_the_past_then_ntp(station) -> None:
    """Up at 14:01:30 with a clock of years ago; NTP comes at 14:04."""
    wake(station, -WRONG)
    station.run(5, {2: ntp(station, WRONG)}, boot_id="boot-2")
    assert station.minutes() == [0, 1, 122, 123, 124, 125, 126]
    assert station.gaps() == [(2, 121, "power_loss")]
    assert station.store.undated() == []
    frames_are_where_rows_say(station)


def test_wake_in_the_past_then_set_by_hand(station) -> None:
    """The gap says what was power and what was the clock, although no pair can be dated."""
    wake(station, -WRONG)
    station.run(5, {2: set_clock(station, WRONG)}, boot_id="boot-2")
    assert station.minutes() == [0, 1, 124, 125]
    assert station.gaps() == [(2, 121, "power_loss"), (122, 123, "clock_wrong")]
    assert len(station.store.undated("boot-2")) == 3


def test_the_daemon_dies_while_the_clock_is_wrong(station) -> None:
    wake(station, -WRONG)
    station.run(2, boot_id="boot-2")
    station.clock.advance(90)
    station.run(4, {1: ntp(station, WRONG)}, boot_id="boot-2")
    assert station.minutes() == [0, 1, 122, 123, 125, 126, 127, 128]
    assert station.gaps() == [(2, 121, "power_loss"), (124, 124, "clock_wrong")]


def test_power_fails_again_before_the_clock_was_right(station) -> None:
    wake(station, -WRONG)
    station.run(2, boot_id="boot-2")
    station.clock.advance(300)
    station.clock.set_utc(station.clock.now_utc() + WRONG)
    station.run(1, boot_id="boot-3")
    assert station.minutes() == [0, 1, 128]
    assert station.gaps() == [(2, 127, "power_loss")]
    assert "2 undated pairs are kept" in station.store.gaps()[0].detail
    assert len(station.store.undated("boot-2")) == 2


def test_wake_with_the_clock_of_the_last_shutdown_then_ntp(station) -> None:
    """A machine without a battery goes on where it was: rows look fine, and are two hours off."""
    wake(station, timedelta(seconds=-OUTAGE_S))
    station.run(3, boot_id="boot-2")
    assert station.minutes() == [0, 1, 2, 3, 4]
    station.run(3, {0: ntp(station, timedelta(seconds=OUTAGE_S))}, boot_id="boot-2")
    assert station.minutes() == [0, 1, 122, 123, 124, 125, 126, 127]
    assert station.gaps() == [(2, 121, "power_loss")]
    assert station.store.measurement(slot(123)).redated_from_utc == slot(3)
    frames_are_where_rows_say(station)


def test_heartbeat_never_goes_back(station) -> None:
    wake(station, -WRONG)
    station.run(2, boot_id="boot-2")
    assert datetime.fromisoformat(station.store.get_mark(Mark.HEARTBEAT_UTC)) == slot(1)


# ------------------------------------------------------------------ cut off in the middle


class Cut(BaseException):
    """The power goes."""


@pytest.mark.parametrize("direction", [1, -1][:: one_of(2)])
def test_cut_off_at_any_sync_it_is_finished_at_the_next_start(
    make_station, monkeypatch, direction
) -> None:
    """Moving rows and dating pairs, cut at each fsync in turn: all end at their slots, once."""
    cuts = 0
    while True:
        station = make_station()
        station.synchronised = False
        shift = direction * timedelta(hours=1) + timedelta(seconds=20)
        station.run(3, {0: set_clock(station, shift)})
        station.clock.advance(30)
        station.run(2, {0: set_clock(station, -WRONG)})
        station.clock.advance(30)
        station.clock.set_utc(station.clock.now_utc() + WRONG - shift)
        station.synchronised = True
        done = cut_at(monkeypatch, cuts, lambda station=station: station.run(1))
        monkeypatch.undo()
        if not done:
            station.run(1)
        rows = list(station.store.measurements())
        assert [minute_of(row.slot_utc) for row in rows][:5] == [0, 1, 2, 3, 4]
        assert station.store.undated() == []
        assert all(minute_of(row.slot_utc) < 10 for row in rows)
        frames_are_where_rows_say(station)
        if done:
            break
        cuts += one_of(3)
    assert cuts > 20


def cut_at(monkeypatch, number: int, work) -> bool:
    """Do the work until the given fsync; tell whether it ended before."""
    real, count = os.fsync, iter(range(1_000_000))

    def fsync(descriptor: int) -> None:
        if next(count) >= number:
            raise Cut
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    try:
        work()
    except Cut:
        return False
    return True


def test_putting_right_may_be_repeated(station) -> None:
    station.run(6, {1: set_clock(station, -WRONG), 4: ntp(station, WRONG)})
    before = list(station.store.measurements()), station.gaps()
    put_right(station.context, station.schedule)
    recover(station.context, station.schedule)
    assert (list(station.store.measurements()), station.gaps()) == before
