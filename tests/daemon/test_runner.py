"""Every slot ends as a row or in a gap with its cause, whatever camera, clock and disk do."""

import pytest

from core.results import Flag, Reason
from daemon.store.errors import ArchiveError, DatabaseUnwritableError, DiskFullError
from drivers.errors import DeviceLostError, FrameTimeoutError, IncompleteFrameError


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
        assert row.measurement.reasons == (Reason.NO_CALIBRATION,)
        assert row.captured_utc == slot
        assert not row.recorded_late
        assert (station.state / row.main_frame).is_file()
        assert (station.state / row.sub_frame).is_file()


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (DeviceLostError("main camera is gone", "main"), "camera_lost"),
        (FrameTimeoutError("no frame", "sub"), "camera_lost"),
        (IncompleteFrameError("12 of 100 packets", "sub"), "capture_failed"),
        (RuntimeError("a bug in a driver"), "capture_failed"),
    ],
)
def test_slots_without_a_pair_are_one_gap_with_the_cause(station, error, cause) -> None:
    station.run(5, {1: raising(error), 2: raising(error)})
    assert station.minutes() == [0, 3, 4]
    assert station.gaps() == [(1, 2, cause)]
    assert str(error) in station.store.gaps()[0].detail


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


def test_told_to_stop_it_takes_no_further_slot(station) -> None:
    runner = station.start()
    station.source.orders = {1: station.stop.set}
    assert runner.run() == 2
    assert station.minutes() == [0, 1]
