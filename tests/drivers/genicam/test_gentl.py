"""What is the harvesters backend's own: producers that are missing, hang, crash or lack much."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from drivers.errors import (
    DeviceLostError,
    FrameTimeoutError,
    MissingLibraryError,
    SettingRefusedError,
)
from drivers.genicam.gentl import PRODUCER_PATH, GentlCamera, find_producer
from drivers.protocols import CameraSettings, LineOut, TriggerIn
from tests.drivers.genicam.gentl.bench import faulty, viky
from tests.drivers.genicam.gige import registers
from tests.drivers.genicam.gige.bench import (
    HEIGHT_PX,
    WIDTH_PX,
    gige_network,
    running,
    shoot,
    write_images,
)
from tests.drivers.genicam.gige.kinds import Kind, kind_of
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.drivers.genicam.gige.process import REPOSITORY, CameraProcess

SERIAL = "15290000"
SETTINGS = CameraSettings(WIDTH_PX, HEIGHT_PX)


@pytest.fixture(scope="module")
def kind() -> Iterator[Kind]:
    with gige_network():
        yield kind_of("harvesters")


@pytest.fixture(scope="module")
def process(kind: Kind, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CameraProcess]:
    images = write_images(tmp_path_factory.mktemp("images"), 2, seed=9)
    camera = kind.process(ADDRESSES[0], SERIAL, images)
    with running(camera):
        yield camera


# --- which producer


def test_the_configured_producer_goes_before_the_environment(tmp_path: Path) -> None:
    one, other = tmp_path / "one.cti", tmp_path / "other.cti"
    one.touch()
    assert find_producer(None, {PRODUCER_PATH: f"/nowhere:{tmp_path}:"}) == one
    other.touch()
    assert find_producer(other, {PRODUCER_PATH: str(tmp_path)}) == other
    with pytest.raises(MissingLibraryError, match=r"several .*producer to one of .*one.*other"):
        find_producer(None, {PRODUCER_PATH: str(tmp_path)})


@pytest.mark.parametrize("value", [None, "/nowhere"])
def test_without_a_producer_the_message_says_what_to_set(value: str | None) -> None:
    environ = {} if value is None else {PRODUCER_PATH: value}
    with pytest.raises(MissingLibraryError, match=r"set genicam\.producer.*\(GENICAM_GENTL64"):
        find_producer(None, environ)
    with pytest.raises(MissingLibraryError, match=r"/nowhere/x\.cti: no such GenTL producer"):
        find_producer(Path("/nowhere/x.cti"), environ)


def test_a_file_that_is_no_producer_is_named(tmp_path: Path) -> None:
    text = tmp_path / "text.cti"
    text.write_text("not a library")
    with pytest.raises(MissingLibraryError, match=r"text\.cti: not a GenTL producer that can be"):
        GentlCamera("0", SETTINGS, text).open()


# --- a producer of others: real, and with less than a camera needs


def test_a_camera_without_trigger_and_exposure_is_refused_in_one_line() -> None:
    with pytest.raises(SettingRefusedError) as refused:
        GentlCamera("1", CameraSettings(64, 64, exposure_us=1000.0), viky(), "main").open()
    text = str(refused.value)
    assert text.startswith("camera 1: has no TriggerMode, TriggerSource, TriggerSoftware, Exp")
    assert "\n" not in text
    assert refused.value.role == "main"


def test_its_cameras_are_found_by_serial() -> None:
    with pytest.raises(DeviceLostError, match=r"camera 9: not found; viky\.cti finds 0, 1, 2\."):
        GentlCamera("9", SETTINGS, viky()).open()


# --- lines


def test_a_line_that_can_only_be_the_other_way_is_refused(
    kind: Kind, process: CameraProcess
) -> None:
    """GenApi keeps such locks; Aravis leaves them to the camera."""
    output, trigger = LineOut("Line0"), TriggerIn("Line1")
    with pytest.raises(SettingRefusedError, match="LineMode = Output refused"):
        kind.make(SERIAL, dataclasses.replace(SETTINGS, line_out=output), None).open()
    with pytest.raises(SettingRefusedError, match="LineMode = Input refused"):
        kind.make(SERIAL, dataclasses.replace(SETTINGS, trigger=trigger), None).open()
    fixed = dataclasses.replace(SETTINGS, line_out=LineOut("Line1"))
    with closing(kind.make(SERIAL, fixed, None)) as camera:
        camera.open()
        assert process.register(registers.LINE_SOURCE + 4) == registers.EXPOSURE_ACTIVE


# --- a producer that is at fault


def test_a_producer_that_hangs_costs_its_deadline_and_nobody_elses(tmp_path: Path) -> None:
    """Other threads of this program go on meanwhile, and no process stays."""
    stop, longest_s = threading.Event(), [0.0]

    def tick() -> None:
        last_s = time.monotonic()
        while not stop.wait(0.01):
            now_s = time.monotonic()
            longest_s[0], last_s = max(longest_s[0], now_s - last_s), now_s

    ticking = threading.Thread(target=tick)
    ticking.start()
    settings = CameraSettings(WIDTH_PX, HEIGHT_PX, open_timeout_s=3.0)
    camera = GentlCamera(SERIAL, settings, faulty(tmp_path, crashes=False))
    with pytest.raises(DeviceLostError, match=r"no answer within 3 s to start"):
        camera.open()
    stop.set()
    ticking.join()
    assert longest_s[0] < 1.5
    assert not _workers()


def test_a_producer_that_crashes_is_a_lost_camera(tmp_path: Path) -> None:
    camera = GentlCamera(SERIAL, SETTINGS, faulty(tmp_path, crashes=True), "sub")
    with pytest.raises(DeviceLostError, match=r"faulty\.cti crashed \(SIGSEGV\)") as lost:
        camera.open()
    assert lost.value.role == "sub"
    assert not _workers()


@pytest.mark.parametrize("hangs", [False, True])
def test_no_process_outlives_a_program_that_was_killed(
    kind: Kind, process: CameraProcess, tmp_path: Path, hangs: bool
) -> None:
    """It ends by itself, even in a call that would never return."""
    program = (
        "from pathlib import Path\n"
        "from drivers.genicam.gentl import GentlCamera\n"
        "from drivers.protocols import CameraSettings\n"
        f"settings = CameraSettings({WIDTH_PX}, {HEIGHT_PX}, open_timeout_s=2.0)\n"
        "from tests.drivers.genicam.gentl.bench import producer\n"
        "cti = Path({}) if {} else producer()\n"
        f"camera = GentlCamera({SERIAL!r}, settings, cti)\n"
        "print('begins', flush=True)\n"
        "camera.open()\n"
        "print('open', flush=True)\n"
        "import time; time.sleep(60)\n"
    ).format(repr(str(faulty(tmp_path, crashes=False))), hangs)
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        wanted = "begins" if hangs else "open"
        assert any(line.rstrip() == wanted for line in other.stdout)
        _wait_for(lambda: bool(_workers(other.pid)))
        (worker,) = _workers(other.pid)
        other.kill()
    _wait_for(lambda: not _is_alive(worker))


def test_ctrl_c_and_systemds_stop_leave_the_camera_to_the_program(
    kind: Kind, process: CameraProcess
) -> None:
    camera = kind.make(SERIAL, SETTINGS, None)
    camera.open()
    shoot(camera)
    (worker,) = _workers()
    assert os.getpgid(worker) != os.getpgid(0)  # a terminal's Ctrl-C does not come to it
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(worker, number)
    shoot(camera)
    camera.close()
    assert not _workers()


def test_a_spurious_edge_between_slots_is_dropped_and_in_the_programs_own_log(
    kind: Kind, process: CameraProcess
) -> None:
    settings = CameraSettings(WIDTH_PX, HEIGHT_PX, trigger=TriggerIn("Line3"))
    camera = kind.make(SERIAL, settings, None)
    camera.open()
    sent = len(process.frames)
    process.send("edge 3")
    process.wait_for_sent(sent + 1)
    with capture_logs() as logs:

        def dropped() -> bool:
            camera.arm()
            return any(log["event"] == "stale_frames_dropped" for log in logs)

        _wait_for(dropped)  # the frame is still on its way
    assert [(log["serial"], log["log_level"]) for log in logs] == [(SERIAL, "info")]
    with pytest.raises(FrameTimeoutError):
        camera.fetch(0.1)
    camera.close()


def test_reconnects_leave_no_handle_and_no_process(kind: Kind, process: CameraProcess) -> None:
    camera = kind.make(SERIAL, SETTINGS, None)
    handles = []
    for _ in range(4):
        camera.open()
        shoot(camera)
        camera.close()
        handles.append(len(list(Path("/proc/self/fd").iterdir())))
        assert not _workers()
    assert handles[-1] == handles[1], handles


def _workers(parent: int | None = None) -> list[int]:
    """The processes that a program has started for its cameras."""
    found = []
    for task in Path(f"/proc/{parent or os.getpid()}/task").iterdir():
        for child in (task / "children").read_text().split():
            command = Path(f"/proc/{child}/cmdline").read_bytes()
            if b"drivers.genicam.gentl_worker" in command:
                found.append(int(child))
    return found


def _is_alive(process: int) -> bool:
    """Whether it runs; a dead one that nobody has waited for does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def _wait_for(true: Callable[[], bool]) -> None:
    """Wait for what has no event to wait for: the end of somebody else's process."""
    deadline_s = time.monotonic() + 30.0
    while not true():
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.02)
