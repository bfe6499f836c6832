"""After an absence the time is accounted for by its cause, and what was left is measured."""

from datetime import timedelta

import pytest

from core.results import Reason
from daemon.slots.pipeline import record_late
from daemon.slots.recovery import mark_stop, recover
from drivers.frameset import read_frame_set
from tests.daemon.times import slot


def leave_frames(station, minute: int) -> None:
    """What a kill between the frames and the row leaves."""
    station.archive.store(slot(minute), station.source.capture(slot(minute)), slot(minute))


@pytest.mark.parametrize(
    ("stopped", "boot_id", "cause"),
    [
        (True, "boot-1", "stopped"),
        (True, "boot-2", "stopped"),
        (False, "boot-1", "crash"),
        (False, "boot-2", "power_loss"),
    ],
)
def test_absence_is_a_gap_with_its_cause(station, stopped, boot_id, cause) -> None:
    station.run(2)
    if stopped:
        mark_stop(station.store, station.clock.now_utc())
    station.clock.advance(300)
    station.run(2, boot_id=boot_id)
    assert station.minutes() == [0, 1, 6, 7]
    assert station.gaps() == [(2, 5, cause)]


def test_crash_after_a_clean_stop_and_a_new_start_is_a_crash(station) -> None:
    station.run(1)
    mark_stop(station.store, station.clock.now_utc())
    station.clock.advance(120)
    station.run(1)
    station.clock.advance(120)
    station.run(1)
    assert station.gaps() == [(1, 1, "stopped"), (3, 3, "crash")]


def test_recovery_may_be_repeated(station) -> None:
    station.run(2)
    leave_frames(station, 2)
    station.clock.advance(300)
    first = recover(station.context, station.schedule)
    before = station.gaps(), station.minutes(), list(station.store.measurements())
    assert recover(station.context, station.schedule) == first
    assert (station.gaps(), station.minutes(), list(station.store.measurements())) == before


def test_frames_without_a_row_are_measured_under_their_own_slot(station) -> None:
    station.run(2)
    leave_frames(station, 2)
    leave_frames(station, 4)
    station.clock.advance(300)
    station.run(1)
    assert station.minutes() == [0, 1, 2, 4, 6]
    assert station.gaps() == [(3, 3, "crash"), (5, 5, "crash")]
    late = station.store.measurement(slot(2))
    assert late.recorded_late
    assert late.captured_utc == slot(2)
    assert late.skew_s == 0.001
    assert late.main_camera.exposure_us == 5000.0


def test_frames_whose_table_line_was_torn_are_measured_too(station) -> None:
    station.run(1)
    leave_frames(station, 1)
    table = next(station.archive.directory.rglob("frames.csv"))
    table.write_bytes(table.read_bytes()[:-20])
    station.clock.advance(120)
    station.run(1)
    assert station.minutes() == [0, 1, 2]
    assert [row.slot_utc for row in read_frame_set(table.parent).rows] == [
        slot(0),
        slot(1),
        slot(2),
    ]


def test_damaged_frames_become_a_row_that_says_so(station) -> None:
    station.run(1)
    leave_frames(station, 1)
    image = max(station.archive.directory.rglob("*_sub.png"))
    image.write_bytes(image.read_bytes()[:100])
    station.clock.advance(120)
    station.run(1)
    row = station.store.measurement(slot(1))
    assert Reason.SUB_IMAGE_UNREADABLE in row.measurement.reasons


def test_first_start_has_no_gap_before_it(station) -> None:
    station.run(1)
    assert station.gaps() == []


def test_a_slot_that_is_due_at_the_first_start_is_taken(station) -> None:
    """The first start falls on a slot, or just after it: that slot is the record's first."""
    station.clock.set_utc(slot(0) + timedelta(seconds=1))
    station.run(2)
    assert station.minutes() == [0, 1]
    assert station.gaps() == []


def test_crash_before_the_first_slot_is_accounted_from_the_start(station) -> None:
    station.start()
    station.clock.advance(180)
    station.run(1)
    assert station.gaps() == [(0, 2, "crash")]
    assert station.minutes() == [3]


def test_row_taken_by_hand_in_between_hides_no_missed_slot(station) -> None:
    """Stopped after 12:01; somebody takes a pair at 12:04; started again at 12:06."""
    station.run(2)
    mark_stop(station.store, station.clock.now_utc())
    station.clock.advance(180)
    leave_frames(station, 4)
    record_late(station.context, slot(4))
    station.clock.advance(120)
    station.run(1)
    assert station.minutes() == [0, 1, 4, 6]
    assert station.gaps() == [(2, 3, "stopped"), (5, 5, "stopped")]


def test_other_period_after_a_restart_goes_on_with_its_own_grid(station) -> None:
    station.run(2)
    mark_stop(station.store, station.clock.now_utc())
    station.schedule = type(station.schedule)(period_s=30)
    station.clock.advance(90)
    runner = station.start()
    assert runner.run(1) == 1
    gap = station.store.gaps()[0]
    assert (gap.first_slot_utc, gap.period_s) == (slot(1) + timedelta(seconds=30), 30)


def test_a_pair_that_breaks_the_program_keeps_no_start_from_its_slots(station, monkeypatch) -> None:
    station.run(2)
    leave_frames(station, 2)
    station.clock.advance(130)
    with monkeypatch.context() as broken:
        broken.setattr("daemon.slots.pipeline.measure_stored", lambda *_: 1 / 0)
        station.run(1)
    assert station.minutes() == [0, 1, 4]
    assert [(first, last) for first, last, _ in station.gaps()] == [(2, 3)]
    station.run(1)
    assert station.minutes() == [0, 1, 2, 4, 5]
