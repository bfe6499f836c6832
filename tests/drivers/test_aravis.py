"""The Aravis camera on real GigE Vision: selection, set-up, and every fault a link can have."""

from __future__ import annotations

import builtins
import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from drivers.aravis import AravisCamera
from drivers.aravis_device import AravisFeatures
from drivers.errors import (
    DeviceError,
    DeviceLostError,
    FrameTimeoutError,
    IncompleteFrameError,
    MissingLibraryError,
    SettingRefusedError,
)
from drivers.protocols import CameraSettings
from tests.gige.bench import (
    HEIGHT_PX,
    WIDTH_PX,
    gige_network,
    image_index,
    read_pixels,
    running,
    shoot,
    write_images,
)
from tests.gige.loopback import ADDRESSES
from tests.gige.process import REPOSITORY, CameraProcess

MAIN, SUB = "15290000", "15290001"
SETTINGS = CameraSettings(WIDTH_PX, HEIGHT_PX)


@pytest.fixture(scope="module")
def network() -> Iterator[None]:
    with gige_network():
        yield


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_images(tmp_path_factory.mktemp("images"), 3, seed=2)


@pytest.fixture
def process(network: None, images: list[Path]) -> Iterator[CameraProcess]:
    camera = CameraProcess(ADDRESSES[0], MAIN, images)
    with running(camera):
        yield camera


@pytest.fixture
def camera(process: CameraProcess) -> Iterator[AravisCamera]:
    opened = AravisCamera(MAIN, SETTINGS, role="main")
    opened.open()
    yield opened
    opened.close()


def opened(serial: str, **settings: Any) -> AravisCamera:
    values = {"width_px": WIDTH_PX, "height_px": HEIGHT_PX, **settings}
    camera = AravisCamera(serial, CameraSettings(**values))
    camera.open()
    return camera


def outcome(camera: AravisCamera, timeout_s: float) -> DeviceError | None:
    """The error of one shot; None when it gave a frame."""
    try:
        shoot(camera, timeout_s)
    except DeviceError as error:
        return error
    return None


# --- which camera


def test_two_cameras_are_told_apart_by_serial_wherever_they_are(
    network: None, tmp_path: Path
) -> None:
    images = {MAIN: write_images(tmp_path, 1, seed=3), SUB: write_images(tmp_path, 1, seed=4)}
    for addresses in (ADDRESSES, ADDRESSES[::-1]):
        processes = [
            CameraProcess(address, serial, images[serial])
            for address, serial in zip(addresses, (MAIN, SUB), strict=True)
        ]
        with running(*processes):
            for serial in (MAIN, SUB):
                camera = opened(serial)
                assert image_index(shoot(camera).pixels, images[serial]) == 0
                camera.close()


def test_a_wrong_serial_is_answered_with_the_ones_there_are(process: CameraProcess) -> None:
    with pytest.raises(DeviceLostError, match=f"999.*not found.*{MAIN} at {ADDRESSES[0]}"):
        opened("999")


def test_a_camera_in_use_is_not_taken_over(
    camera: AravisCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.aravis_device.CONTROL_WAIT_S", 0.0)
    with pytest.raises(DeviceLostError, match="in use by another program"):
        opened(MAIN)
    assert shoot(camera).pixels.shape == (HEIGHT_PX, WIDTH_PX)


def test_a_camera_whose_program_was_killed_is_taken_over_when_it_forgets_it(
    process: CameraProcess,
) -> None:
    program = (
        "from drivers.aravis import AravisCamera\n"
        "from drivers.protocols import CameraSettings\n"
        f"AravisCamera('{MAIN}', CameraSettings({WIDTH_PX}, {HEIGHT_PX})).open()\n"
        "print('open', flush=True)\n"
        "import time; time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert any(line.startswith("open") for line in other.stdout)
        other.kill()
    camera = opened(MAIN)
    assert shoot(camera).pixels.shape == (HEIGHT_PX, WIDTH_PX)
    camera.close()


# --- set-up


def test_every_automatic_mode_is_off_and_what_was_asked_is_read_back(
    process: CameraProcess,
) -> None:
    camera = opened(MAIN, exposure_us=20_000.0, gain_db=6.0)
    frame = shoot(camera)
    assert (frame.exposure_us, frame.gain_db) == (20_000.0, 6.0)
    assert frame.temperature_c == 41.5
    device = camera._opened.session._device._device  # type: ignore[union-attr]
    for name in ("ExposureAuto", "GainAuto", "AcquisitionFrameRateAuto"):
        assert device.get_string_feature_value(name) == "Off"
    for name in ("GammaEnabled", "ReverseX", "AcquisitionFrameRateEnabled"):
        assert not device.get_boolean_feature_value(name)
    assert device.get_string_feature_value("TriggerSource") == "Software"
    camera.close()


def test_without_a_configured_exposure_and_gain_they_are_5_ms_and_the_lowest(
    camera: AravisCamera,
) -> None:
    frame = shoot(camera)
    assert (frame.exposure_us, frame.gain_db) == (5000.0, 0.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"exposure_us": 1.0},
            r"ExposureTime = 1 us refused: the camera takes 4\.83 to 3\.19e\+07",
        ),
        ({"exposure_us": 1e9}, r"ExposureTime = 1e\+09 us refused: the camera takes 4\.83 to"),
        ({"gain_db": 40.0}, r"Gain = 40 dB refused: the camera takes 0 to 29\.996 dB"),
        (
            {"width_px": WIDTH_PX + 4},
            r"Width = 100 refused: the camera takes 8 to 96 in steps of 4",
        ),
        ({"height_px": HEIGHT_PX - 1}, r"Height = 63 refused: the camera takes 8 to 64 in steps"),
        (
            {"packet_size_bytes": 100},
            r"GevSCPSPacketSize = 100 refused: the camera takes 576 to 9000",
        ),
    ],
)
def test_a_setting_out_of_range_is_refused_with_its_limits(
    process: CameraProcess, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingRefusedError, match=f"camera {MAIN}: .*{message}"):
        opened(MAIN, **settings)


def test_a_smaller_image_is_the_middle_of_the_sensor(
    process: CameraProcess, images: list[Path]
) -> None:
    camera = opened(MAIN, width_px=64, height_px=32)
    whole = read_pixels(images[0])
    assert np.array_equal(shoot(camera).pixels, whole[16:48, 16:80])
    camera.close()
    camera = opened(MAIN)  # the offsets left behind do not limit the size
    assert np.array_equal(shoot(camera).pixels, read_pixels(images[1]))
    camera.close()


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_deeper_pixels_come_whole(network: None, tmp_path: Path, bits: int) -> None:
    images = write_images(tmp_path, 2, seed=5, bits=bits)
    with running(CameraProcess(ADDRESSES[0], MAIN, images)):
        camera = opened(MAIN, pixel_format=f"Mono{bits}")
        frame = shoot(camera)
        assert frame.bits == bits
        assert frame.pixels.dtype == np.uint16
        assert image_index(frame.pixels, images) == 0
        camera.close()


def test_a_camera_with_the_older_names_and_no_gamma_works(
    network: None, images: list[Path]
) -> None:
    """Aravis' own description: ExposureTimeAbs, GainRaw, nothing else that we set."""
    with running(CameraProcess(ADDRESSES[0], MAIN, images, ["--stock-xml"])):
        camera = opened(MAIN, exposure_us=300.0)
        frame = shoot(camera)
        assert frame.exposure_us == 300.0
        assert frame.gain_db is None
        assert image_index(frame.pixels, images) == 0
        camera.close()
        with pytest.raises(SettingRefusedError, match=r"Gain = 3\.0 refused: .* units of its own"):
            opened(MAIN, gain_db=3.0)


def test_a_camera_that_sends_frames_untriggered_is_refused(
    process: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.genicam_setup._set_trigger", lambda _writer, _trigger: None)
    with pytest.raises(SettingRefusedError, match="frames come without trigger"):
        opened(MAIN)


def test_a_value_the_camera_rounds_is_logged(
    process: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = AravisFeatures.read

    def read_half(features: AravisFeatures, name: str) -> Any:
        value = read(features, name)
        return 0.5 * float(value) if name == "ExposureTime" else value

    monkeypatch.setattr(AravisFeatures, "read", read_half)
    with capture_logs() as logs:
        camera = opened(MAIN, exposure_us=1000.0)
    assert shoot(camera).exposure_us == 500.0
    camera.close()
    differs = [log for log in logs if log["event"] == "camera_setting_differs"]
    assert [(log["feature"], log["wanted"], log["actual"]) for log in differs] == [
        ("ExposureTime", 1000.0, 500.0)
    ]


def test_without_the_library_the_message_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real_import = builtins.__import__

    def no_gi(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "gi":
            msg = "No module named 'gi'"
            raise ImportError(msg)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_gi)
    with pytest.raises(MissingLibraryError, match=r"apt-get install .*gir1\.2-aravis-0\.8"):
        AravisCamera(MAIN, SETTINGS).open()


# --- faults of the link


def test_a_frame_with_packets_missing_is_refused_and_the_next_one_taken(
    camera: AravisCamera, process: CameraProcess
) -> None:
    shoot(camera)
    process.command("lose 1")
    with pytest.raises(FrameTimeoutError):
        shoot(camera, timeout_s=0.5)
    process.command("lose 0.4")
    outcomes = [outcome(camera, timeout_s=1.0) for _ in range(12)]
    refused = [error for error in outcomes if isinstance(error, IncompleteFrameError)]
    assert refused
    assert all(re.search(r"frame \d+ is incomplete .*rmem_max", str(error)) for error in refused)
    assert not any(isinstance(error, DeviceLostError) for error in outcomes)
    process.command("lose 0")
    for _ in range(10):  # more than there are buffers: each was pushed back
        shoot(camera)


def test_a_late_frame_is_not_taken_for_the_next(
    camera: AravisCamera, process: CameraProcess, images: list[Path]
) -> None:
    shoot(camera)
    process.command("late 0.6")
    with pytest.raises(FrameTimeoutError):
        shoot(camera, timeout_s=0.2)
    assert image_index(shoot(camera).pixels, images) == 2


def test_a_camera_that_falls_silent_costs_its_deadline_and_comes_back(
    camera: AravisCamera, process: CameraProcess
) -> None:
    shoot(camera)
    process.freeze()
    start_s = time.monotonic()
    with pytest.raises(DeviceLostError):
        shoot(camera)
    assert time.monotonic() - start_s < 2 * SETTINGS.command_timeout_s + 1.0
    process.thaw()
    camera.open()
    shoot(camera)


def test_a_camera_restarted_behind_our_back_is_noticed(
    camera: AravisCamera, process: CameraProcess
) -> None:
    """It takes commands as if nothing had happened, but never answers a trigger."""
    shoot(camera)
    process.kill()
    process.start()
    outcomes = [outcome(camera, timeout_s=0.3) for _ in range(3)]
    assert any(isinstance(error, DeviceLostError) for error in outcomes)
    assert None not in outcomes
    camera.open()
    shoot(camera)


def test_losing_control_sets_a_flag_and_the_next_call_says_so(camera: AravisCamera) -> None:
    device = camera._opened.session._device._device  # type: ignore[union-attr]
    device.emit("control-lost")
    with pytest.raises(DeviceLostError, match="control lost"):
        camera.arm()
    with pytest.raises(DeviceLostError, match="not open"):
        camera.trigger()


def test_a_library_that_hangs_costs_the_deadline_and_leaves_a_bounded_number_of_threads(
    process: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go = threading.Event()
    monkeypatch.setattr("drivers.aravis_device.load_aravis", lambda: let_go.wait(60.0))
    camera = AravisCamera(MAIN, CameraSettings(WIDTH_PX, HEIGHT_PX, open_timeout_s=0.05))
    for _ in range(10):
        with pytest.raises(DeviceLostError):
            camera.open()
    assert sum(thread.alive for thread in camera._left_behind) <= 5
    with pytest.raises(DeviceLostError, match="calls into Aravis hang; restart"):
        camera.open()
    let_go.set()
    for thread in camera._left_behind:
        thread.end(5.0)


# --- long runs


def _handles() -> tuple[int, int]:
    """Open files and threads of this process."""
    files, threads = Path("/proc/self/fd"), Path("/proc/self/task")
    return len(list(files.iterdir())), len(list(threads.iterdir()))


def _assert_flat(handles: list[tuple[int, int]]) -> None:
    """One more is a thread that has just ended and that the kernel still counts."""
    for first, last in zip(handles[1], handles[-1], strict=True):
        assert last <= first + 1, handles


def test_twenty_reconnects_leave_no_handle_and_no_thread(process: CameraProcess) -> None:
    camera = AravisCamera(MAIN, SETTINGS)
    handles = []
    for _ in range(20):
        camera.open()
        shoot(camera)
        camera.close()
        handles.append(_handles())
    _assert_flat(handles)


def test_losses_leave_no_handle_and_no_thread(process: CameraProcess) -> None:
    """A lost device is released in the background: wait for that before counting."""
    camera = AravisCamera(MAIN, SETTINGS)
    handles = []
    for _ in range(8):
        camera.open()
        camera._opened.session._device._device.emit("control-lost")  # type: ignore[union-attr]
        with pytest.raises(DeviceLostError):
            camera.arm()
        for thread in camera._left_behind:
            thread.end(10.0)
        handles.append(_handles())
    _assert_flat(handles)


def test_a_full_size_frame_is_exact_with_small_and_with_jumbo_packets(
    network: None, tmp_path: Path
) -> None:
    images = write_images(tmp_path, 2, seed=6, shape=(1200, 1920))
    with running(CameraProcess(ADDRESSES[0], MAIN, images)):
        for packet_size in (None, 8192):
            camera = opened(MAIN, width_px=1920, height_px=1200, packet_size_bytes=packet_size)
            assert all(image_index(shoot(camera).pixels, images) is not None for _ in range(6))
            camera.close()


def test_the_camera_of_these_tests_has_a_valid_description() -> None:
    """GenApi, the reference implementation, is stricter than Aravis."""
    genapi = pytest.importorskip("genicam.genapi", exc_type=ImportError)
    nodes = genapi.NodeMap()
    nodes.load_xml_from_file(str(REPOSITORY / "tests/gige/gs3.xml"))
    wanted = {"ExposureTime", "Gain", "GammaEnabled", "TriggerSoftware", "DeviceSerialNumber"}
    assert all(nodes.has_node(name) for name in wanted), json.dumps(sorted(wanted))
