"""What is the harvesters backend's own: producers that are missing, hang, crash or lack much."""

from __future__ import annotations

import dataclasses
import gc
import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
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
from tests.drivers.genicam.gentl.bench import faulty, producer, viky
from tests.drivers.genicam.gige import registers
from tests.drivers.genicam.gige.bench import (
    HEIGHT_PX,
    SETTINGS,
    WIDTH_PX,
    gige_network,
    grab,
    running,
    write_images,
)
from tests.drivers.genicam.gige.kinds import Kind, kind_of
from tests.drivers.genicam.gige.loopback import ADDRESSES
from tests.drivers.genicam.gige.process import REPOSITORY, CameraProcess
from tests.processes import is_alive, read_of
from tests.waiting import PATIENCE_S, wait_for

SERIAL = "15290000"


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


@pytest.mark.usefixtures("forked_workers")
def test_a_file_that_is_no_producer_is_named(tmp_path: Path) -> None:
    text = tmp_path / "text.cti"
    text.write_text("not a library")
    with pytest.raises(MissingLibraryError, match=r"text\.cti: not a GenTL producer that can be"):
        GentlCamera("0", SETTINGS, text).open()


# --- a producer of others: real, and with less than a camera needs


@pytest.mark.usefixtures("forked_workers")
def test_a_camera_without_trigger_and_exposure_is_refused_in_one_line() -> None:
    with pytest.raises(SettingRefusedError) as refused:
        GentlCamera("1", dataclasses.replace(SETTINGS, exposure_us=1000.0), viky(), "main").open()
    text = str(refused.value)
    assert text.startswith("camera 1: has no TriggerMode, TriggerSource, TriggerSoftware, Exp")
    assert "\n" not in text
    assert refused.value.role == "main"


@pytest.mark.usefixtures("forked_workers")
def test_its_cameras_are_found_by_serial() -> None:
    with pytest.raises(DeviceLostError, match=r"camera 9: not found; viky\.cti finds 0, 1, 2\."):
        GentlCamera("9", SETTINGS, viky()).open()


# --- what producers list beside the two cameras


@pytest.mark.usefixtures("forked_workers", "process")
@pytest.mark.parametrize("habit", ["FOREIGN", "TWICE", "TWO_WAYS", "BAD_INTERFACE"])
def test_a_camera_is_found_whatever_else_its_producer_lists(habit: str) -> None:
    with closing(GentlCamera(SERIAL, SETTINGS, producer(habit))) as camera:
        camera.open()
        grab(camera)


@pytest.mark.usefixtures("forked_workers", "process")
def test_a_camera_that_is_listed_twice_is_opened_by_the_way_that_works_and_the_log_says_so() -> (
    None
):
    camera = GentlCamera(SERIAL, SETTINGS, producer("TWO_WAYS"))
    with closing(camera), capture_logs() as logs:
        camera.open()
    (said,) = (log for log in logs if log["event"] == "camera_listed_more_than_once")
    assert said["others"] == [f"no-way/{said['opened']}"]


@pytest.mark.usefixtures("forked_workers", "process")
@pytest.mark.parametrize("habit", [None, "TWICE", "TWO_WAYS"])
def test_a_camera_that_another_program_has_is_in_use_however_often_it_is_listed(
    kind: Kind, habit: str | None
) -> None:
    with closing(kind.make(SERIAL, SETTINGS, None)) as owner:
        owner.open()
        with pytest.raises(DeviceLostError, match="in use by another program"):
            GentlCamera(SERIAL, SETTINGS, producer(habit)).open()
        grab(owner)


@pytest.mark.usefixtures("forked_workers", "process")
def test_another_vendors_camera_with_the_same_number_is_not_taken_for_ours() -> None:
    with pytest.raises(
        DeviceLostError, match=r"2 cameras with this serial .*Others CamX\); disconnect"
    ):
        GentlCamera(SERIAL, SETTINGS, producer("NAMESAKE")).open()


@pytest.mark.usefixtures("forked_workers", "process")
def test_what_is_found_instead_names_devices_without_a_number() -> None:
    found = rf"finds {SERIAL}, Others Gr.*grabber \(which reports no serial number\)\. Check"
    with pytest.raises(DeviceLostError, match=found):
        GentlCamera("9", SETTINGS, producer("FOREIGN")).open()


@pytest.mark.usefixtures("forked_workers", "process")
def test_a_producer_that_cannot_list_its_devices_is_reported_in_its_words() -> None:
    with pytest.raises(DeviceLostError, match=r"cannot list .*device does not answer"):
        GentlCamera(SERIAL, SETTINGS, producer("BAD_DEVICE")).open()


# --- lines


@pytest.mark.usefixtures("forked_workers")
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
    opened, ticks = threading.Event(), itertools.count()

    def tick() -> None:
        while not opened.wait(0.05):
            next(ticks)

    ticking = threading.Thread(target=tick)
    settings = CameraSettings(WIDTH_PX, HEIGHT_PX, open_timeout_s=3.0)
    camera = GentlCamera(SERIAL, settings, faulty(tmp_path, crashes=False))
    ticking.start()
    with pytest.raises(DeviceLostError, match=r"no answer within 3 s to start"):
        camera.open()
    ticked = next(ticks)
    opened.set()
    ticking.join()
    assert ticked >= 5  # of sixty on an idle machine; none while somebody holds the interpreter
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
    timeout_s = 5.0 if hangs else PATIENCE_S
    program = (
        "from pathlib import Path\n"
        "from drivers.genicam.gentl import GentlCamera\n"
        "from drivers.protocols import CameraSettings\n"
        f"settings = CameraSettings({WIDTH_PX}, {HEIGHT_PX}, open_timeout_s={timeout_s})\n"
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
        wait_for(lambda: bool(_workers(other.pid)), "the camera's process")
        (worker,) = _workers(other.pid)
        other.kill()
    wait_for(lambda: not is_alive(worker), "the end of the camera's process")


def test_ctrl_c_and_systemds_stop_leave_the_camera_to_the_program(
    kind: Kind, process: CameraProcess
) -> None:
    camera = kind.make(SERIAL, SETTINGS, None)
    camera.open()
    grab(camera)
    (worker,) = _workers()
    assert os.getpgid(worker) != os.getpgid(0)  # a terminal's Ctrl-C does not come to it
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(worker, number)
    grab(camera)
    camera.close()
    assert not _workers()


@pytest.mark.usefixtures("forked_workers")
def test_a_spurious_edge_between_slots_is_dropped_and_in_the_programs_own_log(
    kind: Kind, process: CameraProcess
) -> None:
    settings = dataclasses.replace(SETTINGS, trigger=TriggerIn("Line3"))
    camera = kind.make(SERIAL, settings, None)
    camera.open()
    sent = len(process.frames)
    process.send("edge 3")
    process.wait_for_sent(sent + 1)
    with capture_logs() as logs:

        def dropped() -> bool:
            camera.arm()
            return any(log["event"] == "stale_frames_dropped" for log in logs)

        wait_for(dropped, "the edge's frame")  # the frame is still on its way
    assert [(log["serial"], log["log_level"]) for log in logs] == [(SERIAL, "info")]
    with pytest.raises(FrameTimeoutError):
        camera.fetch(0.1)
    camera.close()


def test_reconnects_leave_no_handle_and_no_process(kind: Kind, process: CameraProcess) -> None:
    camera = kind.make(SERIAL, SETTINGS, None)
    gc.collect()  # what tests before left open is not closed meanwhile
    handles = []
    for _ in range(4):
        camera.open()
        grab(camera)
        camera.close()
        handles.append(len(list(Path("/proc/self/fd").iterdir())))
        assert not _workers()
    assert handles[-1] <= handles[1], handles


def _workers(parent: int | None = None) -> list[int]:
    """The processes that a program has started for its cameras."""
    return [
        process
        for process in (int(path.name) for path in Path("/proc").glob("[1-9]*"))
        if _parent_of(process) == (parent or os.getpid())
        and b"drivers.genicam.gentl_worker" in read_of(process, "cmdline")
    ]


def _parent_of(process: int) -> int | None:
    fields = read_of(process, "stat").rpartition(b")")[2].split()
    return int(fields[1]) if fields else None
