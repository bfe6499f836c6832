"""What is USB's own, or was first seen there; test_genicam_cameras.py has what all cameras do."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from structlog.testing import capture_logs

from drivers.clock import SystemClock
from drivers.errors import DeviceError, DeviceLostError
from drivers.genicam import aravis_device
from drivers.genicam.aravis import AravisCamera
from drivers.genicam.byte_order import is_swapped
from drivers.genicam.serial_number import is_same_serial, places_of
from drivers.pair import SynchronizedPair
from tests.drivers.genicam.gige.bench import (
    QUIET,
    QUIET_HEIGHT_PX,
    QUIET_WIDTH_PX,
    SETTINGS,
    gige_network,
    grab,
    image_index,
    read_pixels,
    running,
    write_images,
)
from tests.drivers.genicam.usb3.bench import SLOW_EVENTS, Usb3Process, require_bus
from tests.waiting import PATIENCE_S, wait_for

MAIN, SUB = "15290000", "15290001"
CHUNK_ACTIVE, TRIGGER_MODE = 0xB100, 0x300
CPU_CLOCK = 0b110
"""Of a thread, beside its number: as Linux makes the clock of pthread_getcpuclockid(3)."""


@pytest.fixture(scope="module", autouse=True)
def network() -> Iterator[None]:
    """Aravis looks for cameras on the network as well: there are none."""
    require_bus()
    with gige_network():
        yield


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_images(tmp_path_factory.mktemp("images"), 3, seed=2)


@pytest.fixture
def process(images: list[Path]) -> Iterator[Usb3Process]:
    camera = Usb3Process("1", MAIN, images)
    with running(camera):
        yield camera


@contextmanager
def opened(serial: str = MAIN, **settings: Any) -> Iterator[AravisCamera]:
    with closing(AravisCamera(serial, dataclasses.replace(SETTINGS, **settings), "main")) as camera:
        camera.open()
        yield camera


@contextmanager
def one_processor() -> Iterator[None]:
    """Have this process, and the threads it starts, run on one processor."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


# --- the library


def test_no_frame_is_lost_when_a_buffer_returns_before_the_library_lets_go_of_it(
    process: Usb3Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Aravis' thread of events stands still behind a frame that it has just handed over."""
    monkeypatch.setenv(SLOW_EVENTS, "1")
    with one_processor(), opened() as camera:
        for _ in range(100):
            grab(camera)


def test_nothing_runs_between_two_frames(tmp_path: Path) -> None:
    images = write_images(tmp_path, 1, seed=3, shape=(480, 640))
    camera = Usb3Process("1", MAIN, images)
    others = set(worked_s())
    with running(camera), opened(width_px=640, height_px=480) as one:
        grab(one)
        before_s = worked_s()
        time.sleep(2.0)
        after_s = worked_s()
    its = set(before_s) & set(after_s) - others
    assert its
    assert sum(after_s[thread] - before_s[thread] for thread in its) < 0.2


def worked_s() -> dict[int, float]:
    """How long each thread of this process, the libraries' too, has kept a processor busy."""
    spent_s = {}
    for thread in (int(path.name) for path in Path("/proc/self/task").iterdir()):
        with suppress(OSError):  # it has ended meanwhile
            spent_s[thread] = time.clock_gettime(~thread << 3 | CPU_CLOCK)
    return spent_s


def test_a_frame_without_its_image_costs_no_other(process: Usb3Process, images: list[Path]) -> None:
    """It puts Aravis' stream out of step: what comes next is taken for what is missing."""
    with opened() as camera:
        grab(camera)
        process.command("skip")
        with pytest.raises(DeviceError):
            grab(camera, timeout_s=0.3)
        assert image_index(grab(camera).pixels, images) == 2


def test_a_frame_sent_twice_is_taken_once(process: Usb3Process, images: list[Path]) -> None:
    process.command("fault duplicate")
    with opened() as camera:
        shown = [image_index(grab(camera).pixels, images)]
        for _ in range(2):  # not armed again, which would drop the second one unseen
            camera.trigger()
            shown.append(image_index(camera.fetch(PATIENCE_S).pixels, images))
    assert shown == [0, 1, 2]


# --- serial numbers


def test_a_camera_is_found_by_the_number_on_its_label_and_by_the_one_that_usb_gives(
    process: Usb3Process,
) -> None:
    for serial in (MAIN, "00E94E90", "e94e90"):
        with opened(serial) as camera:
            grab(camera)


def test_both_spellings_stand_in_the_message(process: Usb3Process) -> None:
    words = r"15299999 \(on USB 00E9759F\): not found; there is 00E94E90 \(label 15290000\)"
    with pytest.raises(DeviceLostError, match=words), opened("15299999"):
        pass


def test_a_number_is_preferred_to_another_that_only_reads_like_it() -> None:
    assert is_same_serial("15290000", "00E94E90")
    assert not is_same_serial("15290000", "00E94E91")
    assert not is_same_serial("999", "2457")
    assert places_of("20068364", ["0132380C", "20068364"]) == [1]


# --- what another program left, and what a camera does that it should not


def test_chunk_data_left_on_by_another_program_are_switched_off(images: list[Path]) -> None:
    process = Usb3Process("1", MAIN, images, ["--left", f"{CHUNK_ACTIVE:x}=1"])
    with running(process), capture_logs() as logs, opened() as camera:
        assert image_index(grab(camera).pixels, images) == 0
        assert process.register(CHUNK_ACTIVE) == 0
    found = [log["found"] for log in logs if log["event"] == "camera_left_by_another"]
    assert [one["ChunkModeActive"] for one in found] == [True]


def test_a_camera_that_sends_the_high_byte_first_is_noticed_and_put_right(tmp_path: Path) -> None:
    """12 bits in 16; on a scene, not on noise, which looks the same either way."""
    columns = np.linspace(500, 60000, 96).astype(np.uint16) & 0xFFF0
    images = write_images(tmp_path, 1, seed=5, bits=12)
    cv2.imwrite(str(images[0]), np.tile(columns, (64, 1)))
    process = Usb3Process("1", MAIN, images)
    with running(process), capture_logs() as logs, opened(pixel_format="Mono16") as camera:
        assert np.array_equal(grab(camera).pixels, read_pixels(images[0]))
        process.command("fault swapped")
        for _ in range(2):
            assert np.array_equal(grab(camera).pixels, read_pixels(images[0]))
    said = [log["high_byte_first"] for log in logs if log["event"] == "camera_byte_order"]
    assert said == [True]


@pytest.mark.parametrize("light", [1.0, 0.3, 0.01, 0.0])
def test_the_order_of_bytes_shows_in_bright_and_dark_images(light: float) -> None:
    random = np.random.default_rng(1)
    y, x = np.mgrid[0:240, 0:320]
    scene = light * (900 + 600 * np.sin(x / 50) * np.cos(y / 70) + 900 * (x // 120 % 2))
    values = np.clip(random.normal(scene, 2.0 + 0.5 * np.sqrt(scene)), 0, 4095).astype(np.uint16)
    for pixels, bits in ((values, 12), (values << 4, 16), (values * 13, 16)):
        assert is_swapped(pixels, bits) is False
        assert is_swapped(pixels.byteswap(), bits) is True


def test_an_image_that_does_not_show_its_order_is_left_alone() -> None:
    noise = np.random.default_rng(2).integers(0, 65536, (64, 96), dtype=np.uint16)
    assert is_swapped(noise, 16) is None
    assert is_swapped(np.zeros((64, 96), np.uint16), 16) is None


def test_a_clock_that_goes_back_costs_no_frame_and_is_logged(
    process: Usb3Process, images: list[Path]
) -> None:
    with capture_logs() as logs, opened() as camera:
        frame = grab(camera)
        wait_for(lambda: grab(camera).camera_time_ns > 10**9, "a time of more than a second")
        process.command("fault clock-back")
        again = grab(camera)
        assert again.camera_time_ns < 10**9
        assert again.frame_id > frame.frame_id
    assert [log["event"] for log in logs].count("camera_clock_went_back") == 1


# --- between two pairs


def test_a_camera_gone_for_a_moment_between_two_pairs_costs_neither(tmp_path: Path) -> None:
    images = write_images(tmp_path, 3, seed=2, shape=(QUIET_HEIGHT_PX, QUIET_WIDTH_PX))
    main, sub = Usb3Process("1", MAIN, images), Usb3Process("2", SUB, images)
    cameras = [AravisCamera(MAIN, QUIET, "main"), AravisCamera(SUB, QUIET, "sub")]
    pair = SynchronizedPair(*cameras, SystemClock(), open_timeout_s=PATIENCE_S, grace_s=PATIENCE_S)
    with running(main, sub), closing(pair):
        pair.capture(SystemClock().now_utc())
        sub.command("power-cut")
        wait_for(lambda: sub.register(TRIGGER_MODE) == 1, "the camera to be set up again")
        taken = pair.capture(SystemClock().now_utc())
        assert image_index(taken.sub.pixels, images) is not None


# --- messages


def test_a_camera_that_may_not_be_opened_is_named_with_the_cure(
    process: Usb3Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Aravis does not list it; the kernel does."""
    device, node = tmp_path / "sys/bus/usb/devices/2-1", tmp_path / "dev/bus/usb/002/003"
    device.mkdir(parents=True)
    attributes = {"idVendor": "1e10", "serial": "00E94E90", "busnum": "2", "devnum": "3"}
    for name, text in attributes.items():
        (device / name).write_text(text)
    monkeypatch.setattr("drivers.genicam.usb_bus.ROOT", tmp_path)
    monkeypatch.setattr(os, "access", lambda path, _mode: Path(path) != node)
    process.command("fault denied")
    says = r"15290000 .*: plugged in .*, but may not be opened .*002/003.*60-dcam\.rules"
    with pytest.raises(DeviceLostError, match=says):
        AravisCamera(MAIN, SETTINGS).open()


@pytest.mark.filterwarnings("ignore:g_thread_join")  # Aravis, of a camera it could not talk to
def test_a_camera_that_does_not_answer_is_named_with_the_cure(process: Usb3Process) -> None:
    process.command("fault stalled")
    with pytest.raises(DeviceLostError, match="not answer; unplug it and plug it in") as error:
        AravisCamera(MAIN, SETTINGS).open()
    assert "(null)" not in str(error.value)


@pytest.mark.filterwarnings("ignore:g_thread_join")  # Aravis, of a camera it could not claim
def test_a_camera_in_use_says_so(process: Usb3Process, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis_device, "CONTROL_WAIT_S", 0.0)
    with opened() as first:
        with pytest.raises(DeviceLostError, match="in use by another program, which must be st"):
            AravisCamera(MAIN, SETTINGS).open()
        grab(first)
