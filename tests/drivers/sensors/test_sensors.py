"""Sensors as sites have them: files of the kernel's, programs; whatever is wrong is one line."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from drivers.errors import SensorError
from drivers.sensors.command import CommandSensor
from drivers.sensors.file import FileSensor
from tests.waiting import wait_for

ONE_WIRE = "58 01 4b 46 7f ff 0c 10 fe : crc=fe {}\n58 01 4b 46 7f ff 0c 10 fe t=21500\n"


def file_with(directory: Path, text: str) -> FileSensor:
    path = directory / "temp1_input"
    path.write_text(text)
    return FileSensor(path)


def shell(script: str) -> CommandSensor:
    return CommandSensor(["/bin/sh", "-c", script])


@pytest.mark.parametrize(
    ("text", "value"),
    [("23187\n", 23187.0), (" -3.5e1 ", -35.0), (ONE_WIRE.format("YES"), 21500.0)],
)
def test_a_file_gives_its_number(tmp_path: Path, text: str, value: float) -> None:
    assert file_with(tmp_path, text).read(1.0) == value


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "says nothing"),
        ("21,5", "says '21,5', not a number"),
        ("nan", "says 'nan', not a number"),
        (ONE_WIRE.format("NO"), "the 1-wire checksum is wrong"),
        ("junk " * 1000, "not a number"),
        ("\0\xff\n", "not a number"),
    ],
)
def test_a_file_without_a_number_is_named(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(SensorError, match=says) as caught:
        file_with(tmp_path, text).read(1.0)
    assert str(caught.value).startswith(f"{tmp_path}/temp1_input: ")
    assert len(str(caught.value)) < 200


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SensorError, match=r"nothing: cannot be read \(No such file"):
        FileSensor(tmp_path / "nothing").read(1.0)


def test_a_star_stands_for_what_the_kernel_numbers(tmp_path: Path) -> None:
    """As long as it means one file."""
    sensor = FileSensor(tmp_path / "hwmon*" / "temp1_input")
    with pytest.raises(SensorError, match=r"temp1_input: no such files, not one"):
        sensor.read(1.0)
    for number in (3, 4):
        (tmp_path / f"hwmon{number}").mkdir()
    (tmp_path / "hwmon4" / "temp1_input").write_text("1000")
    assert sensor.read(1.0) == 1000.0
    (tmp_path / "hwmon3" / "temp1_input").write_text("2000")
    with pytest.raises(SensorError, match=r"temp1_input: 2 such files, not one"):
        sensor.read(1.0)


def test_a_program_gives_its_number() -> None:
    assert CommandSensor(["/bin/echo", "21.5"]).read(60.0) == 21.5


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("exit 3", "sh: ended with code 3$"),
        ("echo no such chip >&2; echo 5; exit 1", r"sh: ended with code 1 \(no such chip\)"),
        ("true", "sh: says nothing"),
        ("echo 5 6", "sh: says '5 6', not a number"),
        ("kill -SEGV $$", "sh: ended with code -11"),
        ("exec cat /dev/zero", "sh: prints more than a number"),
    ],
)
def test_a_program_without_a_number_is_named(script: str, says: str) -> None:
    with pytest.raises(SensorError, match=says):
        shell(script).read(60.0)


def test_a_program_that_is_not_there_is_named() -> None:
    with pytest.raises(SensorError, match=r"^/nowhere: cannot be started \(No such file"):
        CommandSensor(["/nowhere"]).read(60.0)


def test_no_shell_reads_a_command() -> None:
    assert CommandSensor(
        ["/bin/sh", "-c", 'test "$1" = "; exit 1" && echo 1', "-", "; exit 1"]
    ).read(60.0) == pytest.approx(1.0)


def is_gone(pid_file: Path) -> bool:
    """Whether a process has ended, and has been waited for."""
    text = pid_file.read_text().strip() if pid_file.exists() else ""
    return bool(text) and not Path(f"/proc/{text}").exists()


def test_a_program_that_hangs_is_killed_with_all_that_it_started(tmp_path: Path) -> None:
    """Also one that ignores the polite signals; neither a process nor a zombie is left."""
    own, child = tmp_path / "own", tmp_path / "child"
    script = f"trap '' TERM INT HUP; sleep 1000 & echo $! > {child}; echo $$ > {own}; wait"

    def hung() -> bool:  # again where the computer is too busy to start both within 2 s
        with pytest.raises(SensorError, match=r"sh: no answer within 2 s"):
            shell(script).read(2.0)
        return own.exists() and own.read_text().endswith("\n")

    wait_for(hung, "its start")
    assert is_gone(own)
    wait_for(lambda: is_gone(child), "the end of its child")  # init reaps it, not we


def test_what_a_program_leaves_behind_holds_nothing_up(tmp_path: Path) -> None:
    """A child in the background keeps the pipe open after the number has been printed."""
    child = tmp_path / "child"
    assert shell(f"sleep 1000 & echo $! > {child}; echo 4").read(60.0) == 4.0
    wait_for(lambda: is_gone(child), "the end of its child")


def test_a_program_is_cut_off_when_the_daemon_ends(tmp_path: Path) -> None:
    """And not started again."""
    sensor, own = shell(f"echo $$ > {tmp_path}/own; exec sleep 1000"), tmp_path / "own"
    ended = threading.Event()

    def read() -> None:
        with pytest.raises(SensorError):
            sensor.read(1000.0)
        ended.set()

    threading.Thread(target=read, daemon=True).start()
    wait_for(lambda: own.exists() and own.read_text().endswith("\n"), "its start")
    sensor.stop()
    wait_for(ended.is_set, "the end of the read")
    assert is_gone(own)
    with pytest.raises(SensorError, match="stopped"):
        sensor.read(60.0)


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_reading_again_and_again_leaves_nothing_open() -> None:
    sensor = shell("echo 1")
    sensor.read(60.0)
    before = open_files()
    for _ in range(20):
        sensor.read(60.0)
    assert open_files() == before
