"""A pair says which camera failed, always within its deadline, and opens that one again."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from drivers.clock import SteppedClock
from drivers.errors import DeviceError, DeviceLostError, FrameTimeoutError, IncompleteFrameError
from drivers.pair import FAILURES_TO_REOPEN, LAST_BACK_OFF_S, SynchronizedPair
from tests.drivers.fake_pair import SLOT, FakeCamera, Rig, fails_with, fake_rig


@pytest.fixture
def rig() -> Iterator[Rig]:
    with fake_rig() as made:
        yield made


def test_a_lost_camera_is_left_alone_and_then_opened_again(rig: Rig) -> None:
    """After a loss the camera is closed, not touched during the pause, then opened and used."""
    rig.pair.capture(SLOT)
    rig.main.on["trigger"] = fails_with(DeviceLostError("camera M1: control lost"))
    error = rig.fail()
    assert isinstance(error, DeviceLostError)
    assert error.role == "main"
    rig.main.on.clear()
    error = rig.fail()
    assert str(error) == "camera M1: control lost; next attempt in 1 s"
    assert error.role == "main"
    rig.clock.advance(1.0)
    rig.pair.capture(SLOT)
    assert rig.main.calls[-5:] == ["close", "open", "arm", "trigger", "fetch"]
    assert rig.sub.calls.count("open") == 1


def test_the_pause_grows_to_half_a_minute(rig: Rig) -> None:
    """Attempts to open a dead camera: at most one in 1, 2, 4 ... 30 s; one a minute always."""
    rig.main.on["open"] = fails_with(DeviceLostError("M1"))
    for second in range(200):
        rig.fail()
        assert rig.main.calls.count("open") <= 6 + second // LAST_BACK_OFF_S
        rig.clock.advance(1.0)
    opened = rig.main.calls.count("open")
    rig.clock.advance(60.0)
    rig.fail()
    assert rig.main.calls.count("open") == opened + 1


def test_after_recovery_the_pause_is_short_again(rig: Rig) -> None:
    """The back-off of one fault does not burden the next."""
    for _ in range(6):
        rig.main.on["open"] = fails_with(DeviceLostError("M1 gone"))
        rig.fail()
        rig.clock.advance(60.0)
    rig.main.on.clear()
    rig.pair.capture(SLOT)
    rig.main.on["trigger"] = fails_with(DeviceLostError("M1 gone"))
    rig.fail()
    assert "next attempt in 1 s" in str(rig.fail())


@pytest.mark.parametrize("error", [FrameTimeoutError("S1: no frame"), IncompleteFrameError("S1")])
def test_a_missed_frame_is_no_loss(rig: Rig, error: DeviceError) -> None:
    """A time-out or an incomplete frame fails one slot; only several in a row reopen the camera."""
    rig.sub.on["fetch"] = fails_with(error)
    caught = rig.fail()
    assert type(caught) is type(error)
    assert caught.role == "sub"
    rig.sub.on.clear()
    rig.pair.capture(SLOT)
    assert rig.sub.calls.count("open") == 1
    rig.sub.on["fetch"] = fails_with(error)
    for _ in range(FAILURES_TO_REOPEN):
        rig.fail()
    rig.sub.on.clear()
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)
    assert rig.sub.calls.count("open") == 2


def test_two_dead_cameras_are_both_named(rig: Rig) -> None:
    """When both fail the error names both, and no single role."""
    rig.main.on["open"] = fails_with(DeviceLostError("M1 gone"))
    rig.sub.on["open"] = fails_with(DeviceLostError("S1 gone"))
    error = rig.fail()
    assert (str(error), error.role) == ("M1 gone; S1 gone", None)
    assert isinstance(error, DeviceLostError)


def test_what_both_cameras_say_alike_is_said_once(rig: Rig) -> None:
    for camera in (rig.main, rig.sub):
        camera.on["open"] = fails_with(DeviceLostError("M1 and S1: no library"))
    error = rig.fail()
    assert str(error) == "M1 and S1: no library"


@pytest.mark.parametrize("call", ["open", "arm", "trigger", "fetch"])
def test_a_hung_call_costs_no_more_than_its_deadline(rig: Rig, call: str) -> None:
    """A call that never returns is left behind; later slots fail at once; then it recovers."""
    rig.main.on[call] = rig.main.hang.block
    before = threading.active_count()
    error = rig.fail()
    assert isinstance(error, DeviceLostError)
    assert error.role == "main"
    assert "main camera M1" in str(error)
    assert "did not end within" in str(error)
    for _ in range(20):
        rig.clock.advance(60.0)
        error = rig.fail()
        assert "still has not; restart" in str(error)
    assert threading.active_count() <= before + 3  # two cameras' and the one that watches them
    assert rig.main.calls.count(call) == 1
    rig.let_go()
    rig.main.on.clear()
    assert rig.main.calls[-1] == "close"
    assert threading.active_count() <= before + 2
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)
    assert rig.main.calls[-4:] == ["open", "arm", "trigger", "fetch"]


def test_a_deadline_passes_by_the_clock() -> None:
    """In the other tests it does as soon as a call hangs; here the call would hang for ever."""
    main, sub = FakeCamera("M1"), FakeCamera("S1")
    main.on["open"] = main.hang.block
    pair = SynchronizedPair(main, sub, SteppedClock(SLOT), open_timeout_s=0.05)
    with pytest.raises(
        DeviceLostError, match=r"main camera M1: opening did not end within 0\.05 s"
    ):
        pair.prepare()
    main.hang.release()
    pair.close()


def test_close_does_not_wait_for_a_hung_camera(rig: Rig) -> None:
    """Closing the pair while a camera hangs ends; closing twice is allowed."""
    rig.sub.on["fetch"] = rig.sub.hang.block
    rig.fail()
    rig.pair.close()
    rig.pair.close()
    assert rig.sub.hang.on


@pytest.mark.parametrize("error", [ZeroDivisionError("a bug"), SystemExit("over")])
def test_a_driver_that_breaks_is_named_and_opened_again(rig: Rig, error: Exception) -> None:
    """What is no device's error costs this attempt; both cameras have ended theirs by then."""
    fetched = threading.Event()
    rig.main.on["trigger"] = fails_with(error)
    rig.sub.on["fetch"] = fetched.set
    caught = rig.fail()
    name = type(error).__name__
    assert str(caught) == f"main camera M1: its driver broke ({name}: {error})"
    assert caught.role == "main"
    assert fetched.is_set()
    rig.main.on.clear()
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)
    assert rig.main.calls[-5:] == ["close", "open", "arm", "trigger", "fetch"]


def test_a_close_that_fails_is_nobodys_trouble(rig: Rig) -> None:
    """The camera is opened again all the same, and a thread that ends does so quietly."""
    rig.main.on["arm"] = fails_with(DeviceLostError("M1 gone"))
    rig.main.on["close"] = fails_with(OSError("no such device"))
    rig.fail()
    del rig.main.on["arm"]
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)
    rig.pair.close()
    rig.pair.capture(SLOT)


def test_what_waits_behind_a_hung_call_is_not_made_any_more(rig: Rig) -> None:
    """A camera that hangs in its release is not opened by the slot that had given it up."""
    rig.main.on["arm"] = fails_with(DeviceLostError("M1 gone"))
    rig.main.on["close"] = rig.main.hang.block
    rig.fail()
    del rig.main.on["arm"]
    rig.clock.advance(60.0)
    error = rig.fail()
    assert "did not end within" in str(error)
    calls = rig.main.calls.copy()
    rig.main.on.clear()
    rig.let_go()
    assert rig.main.calls == [*calls, "close"]  # its thread has ended
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)


def test_a_camera_that_hangs_when_asked_to_close_says_so(rig: Rig) -> None:
    rig.pair.capture(SLOT)
    rig.sub.on["close"] = rig.sub.hang.block
    rig.pair.close()
    error = rig.fail()
    assert str(error).startswith("sub camera S1: closing did not end within 5 s, and still")
    rig.let_go()
    rig.pair.capture(SLOT)
