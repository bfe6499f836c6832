"""Every slot ends as a row or in a gap with its cause, whatever camera, clock and disk do."""

from datetime import UTC, datetime

import pytest

from core.results import Flag, Reason
from daemon.errors import ArchiveError, DatabaseDamagedError, DatabaseUnwritableError, DiskFullError
from daemon.slots.supervision import Circuit, ProcessSpentError
from drivers.errors import (
    DeviceHangsError,
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
)


def raising(error: Exception):
    def order() -> None:
        raise error

    return order


def test_slots_become_rows_on_the_minute_with_their_frames(station) -> None:
    station.run(3)
    assert station.minutes() == [0, 1, 2]
    assert station.gaps() == []
    for slot in station.store.measured_slots():
        row = station.store.measurement(slot)
        assert row.measurement.flag is Flag.BAD
        assert row.measurement.reasons == (  # images of noise
            Reason.NO_CALIBRATION,
            Reason.MAIN_TARGET_NOT_FOUND,
            Reason.SUB_TARGET_NOT_FOUND,
        )
        assert row.captured_utc == slot
        assert not row.recorded_late
        assert (station.state / row.main_frame).is_file()
        assert (station.state / row.sub_frame).is_file()


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (DeviceLostError("main camera is gone", "main"), "camera_lost"),
        (FrameTimeoutError("no frame", "sub"), "camera_lost"),
        (RuntimeError("a bug in a driver"), "capture_failed"),
    ],
)
def test_slots_without_a_pair_are_one_gap_with_the_cause(station, error, cause) -> None:
    station.run(5, {1: raising(error), 2: raising(error)})
    assert station.minutes() == [0, 3, 4]
    assert station.gaps() == [(1, 2, cause)]
    assert str(error) in station.store.gaps()[0].detail


def test_a_pair_that_came_incomplete_is_taken_once_more_in_its_slot(station) -> None:
    broken = raising(IncompleteFrameError("12 of 100 packets", "sub"))
    station.run(3, {1: broken, 3: broken, 4: broken})
    assert station.minutes() == [0, 1]
    assert station.gaps() == [(2, 2, "capture_failed")]


def test_what_is_late_already_is_not_taken_again(station) -> None:
    def late() -> None:
        station.clock.advance(1.5)
        raising(IncompleteFrameError("12 of 100 packets", "sub"))()

    station.run(2, {0: late})
    assert station.minutes() == [1]


def test_slots_that_fail_for_an_unexpected_reason_end_the_process(station) -> None:
    """Three in a row; one that went well between them begins the count again."""
    bug = raising(RuntimeError("a bug in a driver"))
    with pytest.raises(ProcessSpentError, match="3 slot") as ended:
        station.run(9, {1: bug, 2: bug, 4: bug, 5: bug, 6: bug})
    assert ended.value.exit_code == 1
    assert station.minutes() == [0, 3]
    assert station.gaps() == [(1, 2, "capture_failed"), (4, 6, "capture_failed")]


def test_every_end_of_a_process_makes_the_next_one_more_patient(station) -> None:
    bug = raising(RuntimeError("a bug in a driver"))
    runner = station.start(circuit=Circuit(ended_before=2))
    station.source.orders = dict.fromkeys(range(20), bug)
    with pytest.raises(ProcessSpentError, match="12 slot"):
        runner.run(20)


def test_a_camera_that_is_lost_never_ends_the_process(station) -> None:
    station.run(100, dict.fromkeys(range(100), raising(DeviceLostError("gone", "main"))))
    assert station.gaps() == [(0, 99, "camera_lost")]


def test_a_library_that_hangs_for_good_ends_the_process_with_the_code_of_hardware(station) -> None:
    hangs = raising(DeviceHangsError("open did not end", "main"))
    with pytest.raises(ProcessSpentError) as ended:
        station.run(100, dict.fromkeys(range(100), hangs))
    assert ended.value.exit_code == 4
    assert station.gaps() == [(0, 29, "camera_lost")]


def test_a_database_damaged_in_a_run_ends_the_process_so_that_the_next_one_salvages(
    station, monkeypatch
) -> None:
    damaged = raising(DatabaseDamagedError("page 7"))
    monkeypatch.setattr(station.store, "add_measurement", lambda _: damaged())
    with pytest.raises((DatabaseDamagedError, ProcessSpentError)) as ended:
        station.run(3)
    assert ended.value.exit_code == 5
    assert len(station.source.captures) == 1


def test_a_break_outside_the_cameras_costs_its_slot_and_its_frames_are_measured_late(
    station, monkeypatch
) -> None:
    real = station.store.add_measurement
    calls = []

    def breaks_once(record) -> None:
        calls.append(record)
        if len(calls) == 1:
            raise ZeroDivisionError
        real(record)

    monkeypatch.setattr(station.store, "add_measurement", breaks_once)
    station.run(2)
    assert station.minutes() == [0, 1]
    assert next(iter(station.store.measurements())).recorded_late


def test_slot_that_takes_too_long_costs_the_next_ones(station) -> None:
    station.run(3, {1: lambda: station.clock.advance(130)})
    assert station.minutes() == [0, 1, 4]
    assert station.gaps() == [(2, 3, "overrun")]


def test_slot_that_is_barely_late_is_taken(station) -> None:
    station.run(3, {1: lambda: station.clock.advance(61)})
    assert station.minutes() == [0, 1, 2]
    assert station.gaps() == []


@pytest.mark.parametrize("error", [DiskFullError("disk full"), ArchiveError("read-only")])
def test_disk_costs_the_frames_before_the_row(station, monkeypatch, error) -> None:
    monkeypatch.setattr(station.archive, "store", lambda *_: raising(error)())
    station.run(2)
    assert station.minutes() == [0, 1]
    row = next(iter(station.store.measurements()))
    assert row.main_frame is None


@pytest.mark.parametrize(
    ("error", "cause"),
    [(DiskFullError("disk full"), "disk_full"), (DatabaseUnwritableError("EIO"), "storage_failed")],
)
def test_rows_refused_are_owed_and_measured_from_their_frames(
    station, monkeypatch, error, cause
) -> None:
    """The database refuses everything for two slots; the frames were kept, so no slot is lost."""
    real = {name: getattr(station.store, name) for name in ("add_measurement", "record_gap")}
    refusing = {"on": False}

    def refusable(name):
        def call(*args, **kwargs):
            if refusing["on"]:
                raise error
            return real[name](*args, **kwargs)

        return call

    for name in real:
        monkeypatch.setattr(station.store, name, refusable(name))

    station.run(4, {1: lambda: refusing.update(on=True), 3: lambda: refusing.update(on=False)})

    assert station.minutes() == [0, 1, 2, 3]
    assert station.gaps() == []
    late = [row for row in station.store.measurements() if row.recorded_late]
    assert len(late) == 2


def test_rows_refused_without_frames_are_a_gap(station, monkeypatch) -> None:
    error = DiskFullError("disk full")
    monkeypatch.setattr(station.archive, "store", lambda *_: raising(error)())
    real = station.store.add_measurement
    monkeypatch.setattr(
        station.store,
        "add_measurement",
        lambda record: raising(error)() if len(station.source.captures) == 2 else real(record),
    )
    station.run(3)
    assert station.minutes() == [0, 2]
    assert station.gaps() == [(1, 1, "disk_full")]


def test_history_tells_when_slots_fail_and_when_they_come_again(station) -> None:
    lost = raising(DeviceLostError("gone", "main"))
    station.run(5, {1: lost, 2: lost})
    assert [event.kind for event in station.store.events()] == ["camera_lost", "slots_again"]


def test_asked_to_stop_it_takes_no_further_slot(station) -> None:
    runner = station.start()
    station.source.orders = {1: station.stop.set}
    assert runner.run() == 2
    assert station.minutes() == [0, 1]


def test_a_process_that_was_held_up_does_not_blame_the_slot_before(station) -> None:
    """SIGSTOP, or a computer that gives it no time, while it waits for a slot."""
    runner = station.start()
    wait_until = station.clock.wait_until

    def held(when_utc: datetime, *arguments: object) -> bool:
        if len(station.source.captures) == 2:
            station.clock.advance((when_utc - station.clock.now_utc()).total_seconds() + 150.0)
            station.clock.wait_until = wait_until
            return True
        return wait_until(when_utc, *arguments)

    station.clock.wait_until = held
    assert runner.run(4) == 4

    assert station.minutes() == [0, 1, 5, 6]
    assert station.gaps() == [(2, 4, "overrun")]
    assert station.store.gaps()[0].detail == (
        "dcamd was held up for 2 min 30 s: it was stopped, or the computer was overloaded"
    )


def test_a_slot_that_took_too_long_is_blamed(station) -> None:
    station.run(3, {1: lambda: station.clock.advance(150.0)})
    assert station.gaps() == [(2, 3, "overrun")]
    assert station.store.gaps()[0].detail == "the slot before took too long"


def test_a_clock_at_the_end_of_the_calendar_neither_ends_dcamd_nor_dates_a_row(station) -> None:
    station.run(2)
    station.clock.set_utc(datetime(9999, 12, 30, 23, 59, 30, tzinfo=UTC))
    station.run(3)
    assert station.minutes() == [0, 1]
    assert len(station.store.undated()) == 3
