"""A pair of cameras gives both frames or says which camera failed, always within its deadline."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from drivers.clock import SteppedClock
from drivers.errors import DeviceError, DeviceLostError, FrameTimeoutError, IncompleteFrameError
from drivers.pair import FAILURES_TO_REOPEN, LAST_BACK_OFF_S, SynchronizedPair
from drivers.protocols import CapturedFrame
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.settings import Scenario, SimSettings
from drivers.sim.world import World
from tests.drivers.hang import Hang, ImpatientThread
from tests.drivers.sim.rigs import site
from tests.waiting import PATIENCE_S

SLOT = datetime(2026, 3, 1, tzinfo=UTC)
PIXELS = np.zeros((4, 6), np.uint8)


class FakeCamera:
    """A camera that does as asked: `on` maps a call's name to what happens in it."""

    def __init__(self, serial: str, trigger_s: float = 0.0) -> None:
        self.serial = serial
        self.is_lost = False
        self.trigger_s = trigger_s
        self.calls: list[str] = []
        self.exposures: list[tuple[float, float | None]] = []
        self.threads: set[int] = set()
        self.hang = Hang()
        self.on: dict[str, Callable[[], None]] = {}
        self.give: object = ...
        """What fetch gives; ...: a new frame."""

    def _called(self, name: str) -> None:
        self.calls.append(name)
        self.threads.add(threading.get_ident())
        self.on.get(name, lambda: None)()

    def open(self) -> None:
        self._called("open")

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        self.exposures.append((exposure_us, gain_db))
        self._called("set_exposure")

    def arm(self) -> None:
        self._called("arm")

    def trigger(self) -> None:
        self._called("trigger")

    def fetch(self, timeout_s: float) -> CapturedFrame:
        self._called("fetch")
        if self.give is not ...:
            return self.give
        return CapturedFrame(PIXELS, 8, self.calls.count("trigger"), 0, self.trigger_s)

    def close(self) -> None:
        self._called("close")


def _raise(error: Exception) -> Callable[[], None]:
    def raise_it() -> None:
        raise error

    return raise_it


class Rig:
    """Two fake cameras, a stepped clock and their pair."""

    def __init__(self) -> None:
        self.main, self.sub = FakeCamera("M1", 7.0), FakeCamera("S1", 7.25)
        self.clock = SteppedClock(SLOT)
        self.pair = SynchronizedPair(
            self.main,
            self.sub,
            self.clock,
            sizes_px=((6, 4), (6, 4)),
            make_thread=self._make_thread,
        )
        self._threads: list[ImpatientThread] = []

    def _make_thread(self, name: str, at_end: Callable[[], None]) -> ImpatientThread:
        hang = (self.sub if name.startswith("sub") else self.main).hang
        self._threads.append(ImpatientThread(name, at_end, hang))
        return self._threads[-1]

    def fail(self) -> DeviceError:
        """Capture, which must fail."""
        with pytest.raises(DeviceError) as caught:
            self.pair.capture(SLOT)
        return caught.value

    def let_go(self) -> None:
        """Let what hangs return, and the threads that were left behind in it end."""
        self.main.hang.release()
        self.sub.hang.release()
        for thread in self._threads:
            if thread.ended:
                thread.wait_for_end()


@pytest.fixture
def rig():
    rig = Rig()
    yield rig
    rig.let_go()
    rig.pair.close()


def test_both_are_armed_then_triggered_from_two_threads(rig: Rig) -> None:
    """Opened once, armed before each trigger, each in its own thread; skew is sub minus main."""
    first, second = rig.pair.capture(SLOT), rig.pair.capture(SLOT)
    assert rig.main.calls == ["open", *["arm", "trigger", "fetch"] * 2]
    assert rig.sub.calls == rig.main.calls
    assert (first.skew_s, second.main.frame_id) == (0.25, 2)
    assert len(rig.main.threads | rig.sub.threads) == 2
    assert threading.get_ident() not in rig.main.threads | rig.sub.threads
    rig.pair.close()
    assert rig.main.calls[-1] == rig.sub.calls[-1] == "close"


def test_an_exposure_is_set_once_before_arming_and_again_to_a_camera_opened_again(
    rig: Rig,
) -> None:
    rig.pair.set_exposure("sub", 800.0, None)
    rig.pair.capture(SLOT)
    rig.pair.set_exposure("sub", 400.0, 6.0)
    rig.pair.capture(SLOT)
    rig.pair.capture(SLOT)
    shot = ["arm", "trigger", "fetch"]
    assert rig.sub.calls == ["open", "set_exposure", *shot, "set_exposure", *shot, *shot]
    assert rig.sub.exposures == [(800.0, None), (400.0, 6.0)]
    rig.sub.on["trigger"] = _raise(DeviceLostError("camera S1: control lost"))
    rig.fail()
    del rig.sub.on["trigger"]
    rig.clock.advance(LAST_BACK_OFF_S)
    rig.sub.calls.clear()
    rig.pair.capture(SLOT)
    assert rig.sub.calls[-5:] == ["open", "set_exposure", *shot]
    assert rig.sub.exposures[-1] == (400.0, 6.0)
    assert rig.main.exposures == []


def test_triggers_meet(rig: Rig) -> None:
    """No camera is triggered before the other one is ready to be."""
    met = threading.Barrier(2)
    rig.main.on["trigger"] = rig.sub.on["trigger"] = lambda: met.wait(PATIENCE_S) and None
    rig.pair.capture(SLOT)
    assert not met.broken


def test_nothing_is_exposed_unless_both_are_ready(rig: Rig) -> None:
    """With one camera missing the other is armed and not triggered."""
    rig.sub.on["open"] = _raise(DeviceLostError("camera S1: not found"))
    error = rig.fail()
    assert (error.role, str(error)) == ("sub", "camera S1: not found")
    assert rig.main.calls == ["open", "arm"]


def test_a_lost_camera_is_left_alone_and_then_opened_again(rig: Rig) -> None:
    """After a loss the camera is closed, not touched during the pause, then opened and used."""
    rig.pair.capture(SLOT)
    rig.main.on["trigger"] = _raise(DeviceLostError("camera M1: control lost"))
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
    rig.main.on["open"] = _raise(DeviceLostError("M1"))
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
        rig.main.on["open"] = _raise(DeviceLostError("M1 gone"))
        rig.fail()
        rig.clock.advance(60.0)
    rig.main.on.clear()
    rig.pair.capture(SLOT)
    rig.main.on["trigger"] = _raise(DeviceLostError("M1 gone"))
    rig.fail()
    assert "next attempt in 1 s" in str(rig.fail())


@pytest.mark.parametrize("error", [FrameTimeoutError("S1: no frame"), IncompleteFrameError("S1")])
def test_a_missed_frame_is_no_loss(rig: Rig, error: DeviceError) -> None:
    """A time-out or an incomplete frame fails one slot; only several in a row reopen the camera."""
    rig.sub.on["fetch"] = _raise(error)
    caught = rig.fail()
    assert type(caught) is type(error)
    assert caught.role == "sub"
    rig.sub.on.clear()
    rig.pair.capture(SLOT)
    assert rig.sub.calls.count("open") == 1
    rig.sub.on["fetch"] = _raise(error)
    for _ in range(FAILURES_TO_REOPEN):
        rig.fail()
    rig.sub.on.clear()
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)
    assert rig.sub.calls.count("open") == 2


def test_two_dead_cameras_are_both_named(rig: Rig) -> None:
    """When both fail the error names both, and no single role."""
    rig.main.on["open"] = _raise(DeviceLostError("M1 gone"))
    rig.sub.on["open"] = _raise(DeviceLostError("S1 gone"))
    error = rig.fail()
    assert (str(error), error.role) == ("M1 gone; S1 gone", None)
    assert isinstance(error, DeviceLostError)


def test_what_both_cameras_say_alike_is_said_once(rig: Rig) -> None:
    for camera in (rig.main, rig.sub):
        camera.on["open"] = _raise(DeviceLostError("M1 and S1: no library"))
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
    rig.main.on["trigger"] = _raise(error)
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
    rig.main.on["arm"] = _raise(DeviceLostError("M1 gone"))
    rig.main.on["close"] = _raise(OSError("no such device"))
    rig.fail()
    del rig.main.on["arm"]
    rig.clock.advance(60.0)
    rig.pair.capture(SLOT)
    rig.pair.close()
    rig.pair.capture(SLOT)


def test_what_waits_behind_a_hung_call_is_not_made_any_more(rig: Rig) -> None:
    """A camera that hangs in its release is not opened by the slot that had given it up."""
    rig.main.on["arm"] = _raise(DeviceLostError("M1 gone"))
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


FRAME = CapturedFrame(PIXELS, 8, 1, 5, 7.0)


@pytest.mark.parametrize(
    ("found", "reported"),
    [
        (None, "gave NoneType instead of a frame"),
        (replace(FRAME, pixels=PIXELS[0]), "gave pixels of shape (6,) instead of rows and columns"),
        (replace(FRAME, pixels=PIXELS[:0]), "gave pixels of shape (0, 6) instead of rows and"),
        (replace(FRAME, pixels=PIXELS * 1.0), "gave pixels of type float64 said to have 8 bits"),
        (replace(FRAME, bits=12), "gave pixels of type uint8 said to have 12 bits"),
        (
            replace(FRAME, pixels=PIXELS.T),
            "gave 4 x 6 px instead of 6 x 4; they look swapped, exchange",
        ),
        (FRAME, "gave frame 1 a second time"),
    ],
)
def test_what_is_no_whole_new_frame_is_refused(rig: Rig, found: object, reported: str) -> None:
    """Whatever a driver hands over: neither archive nor measurement ever meets it."""
    rig.sub.give = FRAME
    rig.pair.capture(SLOT)
    rig.sub.give = found
    error = rig.fail()
    assert isinstance(error, IncompleteFrameError)
    assert str(error).startswith(f"sub camera S1: {reported}")
    assert error.role == "sub"


def test_what_is_no_number_is_not_said_of_a_frame(rig: Rig) -> None:
    rig.sub.give = replace(FRAME, exposure_us=math.inf, gain_db=3.0, temperature_c=math.nan)
    sub = rig.pair.capture(SLOT).sub
    assert (sub.exposure_us, sub.gain_db, sub.temperature_c) == (None, 3.0, None)


def test_a_camera_without_a_clock_counts_from_one_after_each_opening(rig: Rig) -> None:
    """The same number is another frame then; with a clock it is not."""
    for time_ns, again in ((0, True), (5, False)):
        rig.sub.give = replace(FRAME, camera_time_ns=time_ns)
        rig.pair.capture(SLOT)
        rig.pair.close()
        if again:
            rig.pair.capture(SLOT)
        else:
            assert "a second time" in str(rig.fail())


def test_simulated_pair_loses_a_camera_and_gets_it_back() -> None:
    """On the simulated rig: frames of the slot, a loss with its role, then frames again."""
    world = World(site(shrink=8), SimSettings(scenarios=(Scenario("camera_loss", 2, 4, "sub"),)))
    clock = SteppedClock(SLOT)
    pair = SynchronizedPair(
        SimulatedCamera(world, "main", clock), SimulatedCamera(world, "sub", clock), clock
    )
    outcome = []
    for minute in range(7):
        slot = SLOT + timedelta(minutes=minute)
        clock.wait_until(slot, threading.Event())
        try:
            taken = pair.capture(slot)
        except DeviceLostError as error:
            outcome.append(error.role)
        else:
            outcome.append("ok")
            np.testing.assert_array_equal(taken.sub.pixels, world.render("sub", slot))
            assert taken.skew_s == 0.0
    pair.close()
    assert outcome == ["ok", "ok", "sub", "sub", "ok", "ok", "ok"]
