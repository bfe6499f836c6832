"""Every Camera keeps the same promises: GigE by Aravis and harvesters, USB3, the simulated one.

The first three reach a real camera as far as software goes: a process of its own that speaks GigE
Vision over UDP or USB3 Vision over a stand-in for libusb. Replayed frames come in pairs, without a
camera.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from drivers.clock import SteppedClock
from drivers.errors import DeviceLostError, FrameTimeoutError
from drivers.protocols import Camera, CameraSettings, CapturedFrame
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.settings import Scenario, SimSettings
from drivers.sim.world import World
from tests.drivers.genicam.gige.bench import (
    gige_network,
    grab,
    image_index,
    running,
)
from tests.drivers.genicam.gige.bench import write_images as write_noise
from tests.drivers.genicam.gige.kinds import KindName, kind_of
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.drivers.sim.rigs import site

SERIAL = "15290000"


@dataclass(frozen=True, slots=True)
class Bench:
    """A camera, and what its test can do to it."""

    camera: Camera
    settings: CameraSettings
    image_shown: Callable[[np.ndarray], int | None]
    """Which of the scenes that came before the camera this is; None for any other image."""
    next_scene: Callable[[int], None]
    """After so many triggers in all, wait for their frames and change what the camera sees."""
    take_away: Callable[[], None]
    give_back: Callable[[], None]

    def grab(self, n: int) -> CapturedFrame:
        """Take the n-th frame, and turn to the next scene."""
        frame = grab(self.camera)
        self.next_scene(n)
        return frame


@pytest.fixture
def aravis(tmp_path: Path) -> Iterator[Bench]:
    yield from genicam("aravis", tmp_path)


@pytest.fixture
def harvesters(tmp_path: Path, forked_workers: None) -> Iterator[Bench]:
    yield from genicam("harvesters", tmp_path)


def genicam(name: KindName, directory: Path) -> Iterator[Bench]:
    with gige_network():
        kind = kind_of(name)
        settings = replace(kind.settings, exposure_us=2000.0, gain_db=3.0)
        shape = settings.height_px, settings.width_px
        images = write_noise(directory, 5, seed=1, shape=shape)
        camera = kind.make(SERIAL, settings, "main")
        process = kind.process(ADDRESSES[0], SERIAL, images)

        def give_back() -> None:
            process.start()

        with running(process):
            yield Bench(
                camera,
                settings,
                image_shown=lambda pixels: image_index(pixels, images),
                next_scene=process.wait_for_sent,  # it changes by itself
                take_away=process.kill,
                give_back=give_back,
            )
            camera.close()


@pytest.fixture
def usb3(tmp_path: Path) -> Iterator[Bench]:
    yield from genicam("usb3", tmp_path)


@pytest.fixture
def simulated() -> Bench:
    settings = SimSettings(
        scenarios=(Scenario("drift"), Scenario("bridge"), Scenario("camera_loss", 100, 110))
    )
    world = World(site(), settings)
    clock = SteppedClock(settings.start_utc)
    scenes = [clock.now_utc()]

    def go_to(minute: float) -> None:
        clock.wait_until(settings.start_utc + timedelta(minutes=minute), threading.Event())
        scenes.append(clock.now_utc())

    def image_shown(pixels: np.ndarray) -> int | None:
        matches = (np.array_equal(pixels, world.render("main", scene)) for scene in scenes)
        return next((index for index, match in enumerate(matches) if match), None)

    return Bench(
        SimulatedCamera(world, "main", clock, SERIAL, 5000.0, 0.0),
        CameraSettings(world.site.main.width_px, world.site.main.height_px, 5000.0, 0.0),
        image_shown,
        next_scene=go_to,
        take_away=lambda: go_to(105),
        give_back=lambda: go_to(115),
    )


@pytest.fixture(params=["aravis", "harvesters", "usb3", "simulated"])
def bench(request: pytest.FixtureRequest) -> Bench:
    chosen: Bench = request.getfixturevalue(request.param)
    return chosen


def test_frames_are_exact_new_and_dated(bench: Bench) -> None:
    bench.camera.open()
    frames = [bench.grab(n) for n in (1, 2, 3, 4)]
    assert [bench.image_shown(frame.pixels) for frame in frames] == [0, 1, 2, 3]
    for frame in frames:
        assert frame.pixels.shape == (bench.settings.height_px, bench.settings.width_px)
        assert frame.pixels.dtype == np.uint8
        assert frame.bits == 8
        assert frame.exposure_us == pytest.approx(bench.settings.exposure_us)
        assert frame.gain_db == pytest.approx(bench.settings.gain_db)
    for one, next_one in itertools.pairwise(frames):
        assert next_one.frame_id != one.frame_id
        assert next_one.camera_time_ns > one.camera_time_ns
        assert next_one.trigger_monotonic_s > one.trigger_monotonic_s


def test_exposure_and_gain_change_between_frames_within_what_the_camera_can(bench: Bench) -> None:
    """Told by the frames, kept from frame to frame, and forgotten by a camera that is closed."""
    bench.camera.open()
    bench.grab(1)
    seen = []
    for n, wanted in enumerate([(2500.0, 6.0), (1e-3, -99.0), (1000.0, None), None], start=2):
        if wanted is not None:
            bench.camera.set_exposure(*wanted)
        frame = bench.grab(n)
        seen.append((frame.exposure_us, frame.gain_db))
    assert seen == [(2500.0, 6.0), (4.83, 0.0), (1000.0, 0.0), (1000.0, 0.0)]
    bench.camera.close()
    bench.camera.open()
    frame = bench.grab(6)
    assert (frame.exposure_us, frame.gain_db) == (
        bench.settings.exposure_us,
        bench.settings.gain_db,
    )


def test_a_frame_nobody_fetched_is_not_taken_for_the_next(bench: Bench) -> None:
    bench.camera.open()
    bench.grab(1)
    bench.camera.arm()
    bench.camera.trigger()
    bench.next_scene(2)  # and nobody fetches
    assert bench.image_shown(bench.grab(3).pixels) == 2


def test_without_a_trigger_there_is_no_frame_and_the_wait_ends(bench: Bench) -> None:
    bench.camera.open()
    bench.camera.arm()
    with pytest.raises(FrameTimeoutError, match=bench.camera.serial):
        bench.camera.fetch(0.2)
    assert bench.image_shown(bench.grab(1).pixels) == 0


def test_a_camera_that_is_not_open_says_so(bench: Bench) -> None:
    for call in (
        bench.camera.arm,
        bench.camera.trigger,
        lambda: bench.camera.fetch(0.1),
        lambda: bench.camera.set_exposure(1000.0, None),
    ):
        with pytest.raises(DeviceLostError, match=bench.camera.serial):
            call()


def test_a_camera_can_be_closed_twice_and_opened_again(bench: Bench) -> None:
    bench.camera.close()
    bench.camera.open()
    assert bench.image_shown(bench.grab(1).pixels) == 0
    bench.camera.close()
    bench.camera.close()
    with pytest.raises(DeviceLostError):
        bench.camera.arm()
    bench.camera.open()
    assert bench.image_shown(bench.grab(2).pixels) == 1


def test_a_camera_that_went_away_is_lost_and_opened_again_when_back(bench: Bench) -> None:
    bench.camera.open()
    bench.grab(1)
    bench.take_away()
    with pytest.raises(DeviceLostError, match=bench.camera.serial) as lost:
        grab(bench.camera, timeout_s=1.0)
    assert lost.value.role == "main"
    with pytest.raises(DeviceLostError, match=bench.camera.serial):
        bench.camera.open()
    bench.give_back()
    bench.camera.open()
    assert bench.image_shown(grab(bench.camera).pixels) is not None
