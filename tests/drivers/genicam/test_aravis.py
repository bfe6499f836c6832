"""What is Aravis' own; what every GenICam camera does is in `test_genicam_cameras.py`."""

from __future__ import annotations

import builtins
import dataclasses
import functools
import json
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from benchmarks.memory import resident_mb
from drivers.errors import DeviceLostError, MissingLibraryError, SettingRefusedError
from drivers.genicam import aravis_device
from drivers.genicam.aravis import AravisCamera
from drivers.genicam.aravis_device import AravisFeatures
from drivers.protocols import CameraSettings
from tests.drivers.genicam.gige.bench import (
    HEIGHT_PX,
    SETTINGS,
    WIDTH_PX,
    grab,
    image_index,
    running,
    write_images,
)
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.drivers.genicam.gige.process import REPOSITORY, CameraProcess
from tests.drivers.genicam.gige.registers import CONTROL, TRIGGER_MODE
from tests.waiting import wait_for

MAIN, SUB = "15290000", "15290001"
GS3_XML = REPOSITORY / "tests/drivers/genicam/gige/gs3.xml"
UNUSED = 0xB0F0
"""An address that means nothing to the camera."""


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
    wait_for(lambda: not left_behind(), "the device to be released")


def opened(serial: str, **settings: Any) -> AravisCamera:
    camera = AravisCamera(serial, dataclasses.replace(SETTINGS, **settings))
    camera.open()
    return camera


# --- which camera


def test_a_camera_in_use_is_not_taken_over(
    camera: AravisCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.genicam.aravis_device.CONTROL_WAIT_S", 0.0)
    with pytest.raises(DeviceLostError, match="in use by another program"):
        opened(MAIN)
    assert grab(camera).pixels.shape == (HEIGHT_PX, WIDTH_PX)


# --- set-up


def test_a_camera_with_the_older_names_and_no_gamma_works(
    network: None, images: list[Path]
) -> None:
    """Aravis' own description: ExposureTimeAbs, GainRaw, nothing else that we set."""
    with running(CameraProcess(ADDRESSES[0], MAIN, images, ["--stock-xml"])):
        camera = opened(MAIN, exposure_us=300.0)
        frame = grab(camera)
        assert frame.exposure_us == 300.0
        assert frame.gain_db is None
        assert image_index(frame.pixels, images) == 0
        camera.close()
        with pytest.raises(SettingRefusedError, match=r"Gain = 3\.0 refused: .* units of its own"):
            opened(MAIN, gain_db=3.0)


def test_a_camera_that_sends_frames_untriggered_is_refused(
    network: None, images: list[Path], tmp_path: Path
) -> None:
    """It takes the trigger mode, says that it has it, and sends as it likes."""
    xml = tmp_path / "deaf.xml"
    description = GS3_XML.read_text()
    xml.write_text(description.replace(f"{TRIGGER_MODE:#x}<", f"{UNUSED:#x}<"))
    with (
        running(CameraProcess(ADDRESSES[0], MAIN, images, ["--xml", str(xml)])),
        pytest.raises(SettingRefusedError, match="frames come without trigger"),
    ):
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
    assert grab(camera).exposure_us == 500.0
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


def lose_control(process: CameraProcess, camera: AravisCamera) -> None:
    """As when the camera has restarted; Aravis looks every second."""
    process.command(f"put {CONTROL:x}=0")
    wait_for(lambda: camera.is_lost, "the loss to be seen")


def left_behind() -> list[threading.Thread]:
    """Threads of this camera's devices that still have something to release."""
    return [thread for thread in threading.enumerate() if thread.name == f"aravis-{MAIN}"]


def test_losing_control_sets_a_flag_and_the_next_call_says_so(
    process: CameraProcess, camera: AravisCamera
) -> None:
    lose_control(process, camera)
    with pytest.raises(DeviceLostError, match="control lost"):
        camera.arm()
    with pytest.raises(DeviceLostError, match="not open"):
        camera.trigger()


def test_a_library_that_hangs_costs_the_deadline_and_leaves_a_bounded_number_of_threads(
    process: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go = threading.Event()
    monkeypatch.setattr("drivers.genicam.aravis_device.load_aravis", lambda: let_go.wait(60.0))
    camera = AravisCamera(MAIN, CameraSettings(WIDTH_PX, HEIGHT_PX, open_timeout_s=0.05))
    for _ in range(10):
        with pytest.raises(DeviceLostError):
            camera.open()
    assert 0 < len(left_behind()) <= 5
    with pytest.raises(DeviceLostError, match="calls into Aravis hang; restart"):
        camera.open()
    let_go.set()
    wait_for(lambda: not left_behind(), "the threads to end")


# --- long runs


def _handles() -> tuple[int, int]:
    """Open files and threads of this process."""
    files, threads = Path("/proc/self/fd"), Path("/proc/self/task")
    return len(list(files.iterdir())), len(list(threads.iterdir()))


def _assert_flat(handles: list[tuple[int, int]]) -> None:
    """One more is a thread that has just ended and that the kernel still counts."""
    for first, last in zip(handles[1], handles[-1], strict=True):
        assert last <= first + 1, handles


def _reconnect(
    settings: CameraSettings, times: int, *, shots_every: int = 1
) -> list[tuple[int, int]]:
    camera = AravisCamera(MAIN, settings)
    handles = []
    for number in range(times):
        camera.open()
        if number % shots_every == 0:
            grab(camera)
        camera.close()
        handles.append(_handles())
    return handles


def quick_to_open(monkeypatch: pytest.MonkeyPatch) -> CameraSettings:
    """Without what only takes time, one and a half seconds each time a camera is opened.

    That is the look on the network for cameras, the try of packet sizes, the wait for stale
    frames. The test of ten reconnects does all that.
    """
    find = functools.cache(aravis_device.find_device)
    monkeypatch.setattr("drivers.genicam.aravis_device.find_device", find)
    monkeypatch.setattr("drivers.genicam.session.SETTLE_S", 0.0)
    return dataclasses.replace(SETTINGS, packet_size_bytes=1500)


def test_ten_reconnects_leave_no_handle_and_no_thread(process: CameraProcess) -> None:
    _assert_flat(_reconnect(SETTINGS, 10))


def test_two_hundred_reconnects_leave_nothing(
    process: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Handles, threads and memory, after what libraries keep once for all."""
    settings = quick_to_open(monkeypatch)
    handles = _reconnect(settings, 50, shots_every=10)
    grown_mb = []
    for _ in range(3):
        before_mb = resident_mb(os.getpid())
        handles += _reconnect(settings, 50, shots_every=10)
        grown_mb.append(resident_mb(os.getpid()) - before_mb)
    _assert_flat(handles)
    # The buffers of 50 streams would be 1.2 MB, each time; what earlier tests left comes once.
    assert min(grown_mb) < 0.6, grown_mb


def test_losses_leave_no_handle_and_no_thread(
    process: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lost device is released in the background: wait for that before counting."""
    camera = AravisCamera(MAIN, quick_to_open(monkeypatch))
    handles = []
    for _ in range(8):
        camera.open()
        lose_control(process, camera)
        with pytest.raises(DeviceLostError):
            camera.arm()
        wait_for(lambda: not left_behind(), "the device to be released")
        handles.append(_handles())
    _assert_flat(handles)


def test_a_full_size_frame_is_exact_with_the_packet_size_that_was_found(
    network: None, tmp_path: Path
) -> None:
    images = write_images(tmp_path, 2, seed=6, shape=(1200, 1920))
    with running(CameraProcess(ADDRESSES[0], MAIN, images)):
        camera = opened(MAIN, width_px=1920, height_px=1200)
        assert all(image_index(grab(camera).pixels, images) is not None for _ in range(6))
        camera.close()


def test_the_camera_of_these_tests_has_a_valid_description() -> None:
    """GenApi, the reference implementation, is stricter than Aravis."""
    genapi = pytest.importorskip("genicam.genapi", exc_type=ImportError)
    nodes = genapi.NodeMap()
    nodes.load_xml_from_file(str(GS3_XML))
    wanted = {"ExposureTime", "Gain", "GammaEnabled", "TriggerSoftware", "DeviceSerialNumber"}
    assert all(nodes.has_node(name) for name in wanted), json.dumps(sorted(wanted))
