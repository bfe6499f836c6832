"""What holds for a GenICam camera whichever library reaches it, seen from outside.

Each test runs over Aravis and over harvesters with a GenTL producer, on camera processes that speak
real GigE Vision, and over Aravis on ones that speak USB3 Vision; what was set is read in the
camera's own registers.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import (
    DeviceError,
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
    SettingRefusedError,
)
from drivers.protocols import Camera, LineOut, TriggerIn
from tests.drivers.genicam.gige import registers
from tests.drivers.genicam.gige.bench import (
    HEIGHT_PX,
    SETTINGS,
    WIDTH_PX,
    grab,
    image_index,
    read_pixels,
    running,
    write_images,
)
from tests.drivers.genicam.gige.kinds import Kind
from tests.drivers.genicam.gige.loopback import ADDRESSES, THIRD_ADDRESS
from tests.drivers.genicam.gige.process import REPOSITORY, CameraProcess
from tests.waiting import wait_for

pytestmark = pytest.mark.usefixtures("forked_workers")

MAIN, SUB, STANDING = "15290000", "15290001", "15290002"


@pytest.fixture(scope="module")
def images(kind: Kind, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_noise(kind, tmp_path_factory.mktemp("images"), 3, seed=2)


@pytest.fixture
def process(kind: Kind, images: list[Path]) -> Iterator[CameraProcess]:
    camera = kind.process(ADDRESSES[0], MAIN, images)
    with running(camera):
        yield camera


@pytest.fixture(scope="module")
def standing(kind: Kind, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CameraProcess]:
    """A camera for tests that take no frame."""
    images = write_images(tmp_path_factory.mktemp("standing"), 1, seed=2)
    camera = kind.process(THIRD_ADDRESS, STANDING, images)
    with running(camera):
        yield camera


@pytest.fixture
def camera(kind: Kind, process: CameraProcess) -> Iterator[Camera]:
    with closing(kind.make(MAIN, kind.settings, "main")) as opened:
        opened.open()
        yield opened


def write_noise(kind: Kind, directory: Path, n: int, *, seed: int) -> list[Path]:
    """Images of the size that is set."""
    shape = kind.settings.height_px, kind.settings.width_px
    return write_images(directory, n, seed=seed, shape=shape)


def outcome(camera: Camera, timeout_s: float) -> DeviceError | None:
    """The error of one shot; None when it gave a frame."""
    try:
        grab(camera, timeout_s)
    except DeviceError as error:
        return error
    return None


# --- which camera


def test_two_cameras_are_distinguished_by_serial_though_they_changed_places(
    kind: Kind, tmp_path: Path
) -> None:
    images = {
        MAIN: write_noise(kind, tmp_path, 1, seed=3),
        SUB: write_noise(kind, tmp_path, 1, seed=4),
    }
    for addresses in (ADDRESSES, ADDRESSES[::-1]):
        processes = [
            kind.process(address, serial, images[serial])
            for address, serial in zip(addresses, (MAIN, SUB), strict=True)
        ]
        with running(*processes):
            for serial in (MAIN, SUB):
                with closing(kind.make(serial, kind.settings, None)) as camera:
                    camera.open()
                    assert image_index(grab(camera).pixels, images[serial]) == 0


def test_a_wrong_serial_is_answered_with_the_ones_there_are(
    kind: Kind, standing: CameraProcess
) -> None:
    with pytest.raises(DeviceLostError, match=f"999.*not found.*{STANDING}"):
        kind.make("999", kind.settings, None).open()


def test_a_camera_whose_program_was_killed_is_taken_over_when_it_forgets_it(
    kind: Kind, process: CameraProcess
) -> None:
    """And before that, another program is not robbed of it: the same wait ends in a refusal."""
    size = kind.settings.width_px, kind.settings.height_px
    program = (
        "from tests.drivers.genicam.gige.kinds import kind_of\n"
        "from drivers.protocols import CameraSettings\n"
        f"camera = kind_of({kind.name!r}).make(\n"
        f"    {MAIN!r}, CameraSettings{size}, None)\n"
        "camera.open()\n"
        "print('open', flush=True)\n"
        "import time; time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert any(line.rstrip() == "open" for line in other.stdout)
        other.kill()
    with closing(kind.make(MAIN, kind.settings, None)) as camera:
        camera.open()
        assert grab(camera).pixels.shape == size[::-1]


# --- set-up


def test_every_automatic_mode_is_off_and_what_was_asked_is_set(
    kind: Kind, process: CameraProcess
) -> None:
    """On a camera that comes up with all of them on, exposure and gain locked by them."""
    with closing(
        kind.make(MAIN, replace(kind.settings, exposure_us=20_000.0, gain_db=6.0), None)
    ) as camera:
        camera.open()
        frame = grab(camera)
        assert (frame.exposure_us, frame.gain_db) == (20_000.0, 6.0)
        assert frame.temperature_c == 41.5
        for address in (
            registers.EXPOSURE_AUTO,
            registers.GAIN_AUTO,
            registers.FRAME_RATE_AUTO,
            registers.FRAME_RATE_ENABLED,
            registers.GAMMA_ENABLED,
            registers.REVERSE_X,
        ):
            assert process.register(address) == 0, hex(address)
        assert process.register(registers.TRIGGER_SOURCE) == registers.SOFTWARE
        as_double = registers.double_words(20_000.0)
        assert tuple(process.register(registers.EXPOSURE_TIME + k) for k in (0, 4)) == as_double


def test_a_changed_exposure_is_in_the_cameras_own_registers(
    camera: Camera, process: CameraProcess
) -> None:
    """Between two frames, and brought within what the camera takes rather than refused."""
    camera.set_exposure(1234.5, 3.0)
    frame = grab(camera)
    assert (frame.exposure_us, frame.gain_db) == (1234.5, 3.0)
    in_register = tuple(process.register(registers.EXPOSURE_TIME + k) for k in (0, 4))
    assert in_register == registers.double_words(1234.5)
    camera.set_exposure(1e12, 999.0)
    frame = grab(camera)
    assert frame.exposure_us is not None
    assert frame.gain_db is not None
    assert 1e4 < frame.exposure_us < 1e9
    assert 3.0 < frame.gain_db < 100.0


def test_without_a_configured_exposure_and_gain_they_are_5_ms_and_the_lowest(
    camera: Camera,
) -> None:
    frame = grab(camera)
    assert (frame.exposure_us, frame.gain_db) == (5000.0, 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"exposure_us": 1e9}, r"ExposureTime = 1e\+09 us refused: the camera takes 4\.83 to"),
        (
            {"width_px": WIDTH_PX + 4},
            r"Width = 100 refused: the camera takes 8 to 96 in steps of 4",
        ),
        (
            {"width_px": HEIGHT_PX, "height_px": WIDTH_PX},
            "Width x Height = 64 x 96 refused: the camera has 96 x 64 px; .* look swapped in the",
        ),
        (
            {"packet_size_bytes": 100},
            r"GevSCPSPacketSize = 100 refused: the camera takes 576 to 9000",
        ),
        (
            {"line_out": LineOut("Line2", "Sunshine")},
            "LineSource = Sunshine refused.*takes Off, ExposureActive",
        ),
        ({"trigger": TriggerIn("Line7")}, r"LineSelector = Line7 refused: .*Line0, Line1, Line2"),
    ],
)
def test_a_setting_out_of_range_is_refused_with_its_limits(
    kind: Kind, standing: CameraProcess, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingRefusedError, match=f"camera {STANDING}: .*{message}"):
        kind.make(STANDING, replace(SETTINGS, **values), None).open()


def test_a_smaller_image_is_the_middle_of_the_sensor(
    kind: Kind, process: CameraProcess, images: list[Path]
) -> None:
    with closing(
        kind.make(MAIN, replace(kind.settings, width_px=64, height_px=32), None)
    ) as camera:
        camera.open()
        whole = read_pixels(images[0])
        top, left = (whole.shape[0] - 32) // 2, (whole.shape[1] - 64) // 2
        assert np.array_equal(grab(camera).pixels, whole[top : top + 32, left : left + 64])
    with closing(kind.make(MAIN, kind.settings, None)) as camera:
        camera.open()  # the offsets left behind do not limit the size
        assert np.array_equal(grab(camera).pixels, read_pixels(images[1]))


@pytest.mark.parametrize("bits", [12])
def test_deeper_pixels_come_whole(kind: Kind, tmp_path: Path, bits: int) -> None:
    images = write_images(tmp_path, 2, seed=5, bits=bits)
    with running(kind.process(ADDRESSES[0], MAIN, images)):
        with closing(
            kind.make(MAIN, replace(SETTINGS, pixel_format=f"Mono{bits}"), None)
        ) as camera:
            camera.open()
            frame = grab(camera)
        assert frame.bits == bits
        assert frame.pixels.dtype == np.uint16
        assert image_index(frame.pixels, images) == 0


def test_full_size_frames_are_exact(kind: Kind, tmp_path: Path) -> None:
    images = write_images(tmp_path, 2, seed=6, shape=(1200, 1920))
    whole = replace(SETTINGS, width_px=1920, height_px=1200, packet_size_bytes=8192)
    camera = kind.make(MAIN, whole, None)
    with running(kind.process(ADDRESSES[0], MAIN, images)), closing(camera):
        camera.open()
        assert all(image_index(grab(camera).pixels, images) is not None for _ in range(4))


# --- faults of the link


def test_a_frame_with_packets_missing_is_refused_and_the_next_one_taken(
    kind: Kind, camera: Camera, process: CameraProcess
) -> None:
    grab(camera)
    process.command("lose 0.4")
    outcomes: list[DeviceError | None] = []

    def refused() -> list[IncompleteFrameError]:
        outcomes.append(outcome(camera, timeout_s=1.0))
        return [error for error in outcomes if isinstance(error, IncompleteFrameError)]

    wait_for(lambda: len(refused()) >= 3, "frames with packets missing")
    advice = "usbfs_memory" if kind.name == "usb3" else "rmem_max"
    assert all(re.search(rf"is incomplete .*{advice}", str(error)) for error in refused())
    assert not any(isinstance(error, DeviceLostError) for error in outcomes)
    process.command("lose 0")
    for _ in range(10):  # more than there are buffers: each was put back
        grab(camera)


def test_a_late_frame_is_not_taken_for_the_next(
    camera: Camera, process: CameraProcess, images: list[Path]
) -> None:
    """It is late by less than a GigE camera waits for its program, 3 s, in which it is silent."""
    grab(camera)
    process.command("late 1")
    with pytest.raises(FrameTimeoutError):
        grab(camera, timeout_s=0.2)
    assert image_index(grab(camera).pixels, images) == 2


def test_a_camera_that_falls_silent_is_given_up_and_comes_back(
    kind: Kind, process: CameraProcess
) -> None:
    """Given up while it is silent still: it would be so for ever."""
    with closing(kind.make(MAIN, replace(kind.settings, command_timeout_s=4.0), "main")) as camera:
        camera.open()
        grab(camera)
        process.freeze()
        with pytest.raises(DeviceLostError):
            grab(camera)
        process.thaw()
        camera.open()
        grab(camera)


def test_a_camera_restarted_behind_our_back_is_noticed(
    camera: Camera, process: CameraProcess
) -> None:
    """It takes commands as if nothing had happened, but never answers a trigger."""
    grab(camera)
    process.kill()
    process.start()
    outcomes = [outcome(camera, timeout_s=0.3) for _ in range(3)]
    assert any(isinstance(error, DeviceLostError) for error in outcomes)
    assert None not in outcomes
    camera.open()
    grab(camera)


def test_one_of_two_cameras_dies_and_comes_back_without_disturbing_the_other(
    kind: Kind, tmp_path: Path
) -> None:
    images = {
        MAIN: write_noise(kind, tmp_path, 2, seed=7),
        SUB: write_noise(kind, tmp_path, 2, seed=8),
    }
    dying, other = (
        kind.process(address, serial, images[serial])
        for address, serial in zip(ADDRESSES, (MAIN, SUB), strict=True)
    )
    with (
        running(dying, other),
        closing(kind.make(MAIN, kind.settings, "main")) as main,
        closing(kind.make(SUB, kind.settings, "sub")) as sub,
    ):
        for camera in (main, sub):
            camera.open()
            grab(camera)
        dying.kill()
        assert isinstance(outcome(main, 0.5), DeviceLostError)
        taken = [grab(sub)]
        with pytest.raises(DeviceLostError):
            main.open()
        taken.append(grab(sub))
        dying.start()
        main.open()
        taken.append(grab(sub))
        assert image_index(grab(main).pixels, images[MAIN]) == 0
        assert [image_index(frame.pixels, images[SUB]) for frame in taken] == [1, 0, 1]
    assert len(other.frames) == 4  # not one more than was asked for
