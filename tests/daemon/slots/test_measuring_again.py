"""Rows that a wrong clock had dated are measured again between slots, which are not late for it."""

from dataclasses import replace
from datetime import timedelta

from daemon.store.records import Again
from tests.daemon.times import minute_of, slot

AHEAD = timedelta(hours=1, seconds=20)
ROW_S = 10.0
"""What each takes; half of the minute between two slots is given to them."""


def test_no_slot_is_late_for_rows_that_are_measured_again(station, monkeypatch) -> None:
    """Ten rows at most three at a time, the earliest first, until none waits."""
    finish, done, left = station.store.not_measured_again, [], []

    def slow(number: int, why: Again) -> None:
        done.append(station.store.next_to_measure_again()[1])
        station.clock.advance(ROW_S)
        finish(number, why)

    def wrong() -> None:
        station.clock.set_utc(station.clock.now_utc() + AHEAD)

    def right() -> None:
        station.clock.set_utc(station.clock.now_utc() - AHEAD)
        station.synchronised = True

    def look() -> None:
        left.append(sum(entry.again is None for entry in station.store.redated()))

    monkeypatch.setattr(station.store, "not_measured_again", slow)
    station.synchronised = False
    station.run(17, {1: wrong, 11: right} | dict.fromkeys(range(13, 17), look))
    assert station.minutes() == list(range(17))
    assert station.gaps() == []
    assert left == [7, 4, 1, 0]
    assert [minute_of(one) for one in done] == list(range(2, 12))


def test_it_goes_on_where_a_stop_cut_it(station, monkeypatch) -> None:
    """The end of dcamd waits for one row, not for all."""
    finish = station.store.not_measured_again

    def stop(number: int, why: Again) -> None:
        finish(number, why)
        station.stop.set()

    station.run(4)
    for minute in range(3):
        row = station.store.measurement(slot(minute))
        station.store.move_row(
            slot(minute), replace(row, slot_utc=slot(minute - 10), redated_from_utc=slot(minute))
        )
    monkeypatch.setattr(station.store, "not_measured_again", stop)
    station.start().run(2)
    assert [entry.again for entry in station.store.redated()] == [Again.NO_CALIBRATION, None, None]
    monkeypatch.undo()
    station.stop.clear()
    station.run(1)
    assert {entry.again for entry in station.store.redated()} == {Again.NO_CALIBRATION}
