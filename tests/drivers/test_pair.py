"""A pair of cameras gives both frames, whole and new, of one trigger."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from drivers.clock import SteppedClock
from drivers.errors import DeviceLostError, IncompleteFrameError
from drivers.pair import LAST_BACK_OFF_S, SynchronizedPair
from drivers.protocols import CapturedFrame
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.settings import Scenario, SimSettings
from drivers.sim.world import World
from tests.drivers.fake_pair import PIXELS, SLOT, Rig, fails_with, fake_rig
from tests.drivers.sim.rigs import site
from tests.waiting import PATIENCE_S


@pytest.fixture
def rig() -> Iterator[Rig]:
    with fake_rig() as made:
        yield made


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
    rig.sub.on["trigger"] = fails_with(DeviceLostError("camera S1: control lost"))
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
    rig.sub.on["open"] = fails_with(DeviceLostError("camera S1: not found"))
    error = rig.fail()
    assert (error.role, str(error)) == ("sub", "camera S1: not found")
    assert rig.main.calls == ["open", "arm"]


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
