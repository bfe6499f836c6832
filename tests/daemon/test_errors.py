"""Every error becomes one line on stderr and the exit code that scripts rely on."""

import errno
import os
import pwd
import sqlite3
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import click
import pytest

from core.errors import NotObservableError
from daemon.error_report import run
from daemon.errors import (
    ConfigError,
    DatabaseNewerError,
    DcamError,
    HardwareError,
    UsageError,
    WorkFailedError,
)
from drivers.errors import DeviceLostError, FrameSetError


def run_raising(error: BaseException | None, *flags: str) -> int:
    @click.command()
    @click.option("--debug", is_flag=True)
    def command(debug: bool) -> None:
        if error is not None:
            raise error

    return run(command, "dcam-test", flags)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (WorkFailedError("not accepted"), 1, "not accepted"),
        (NotObservableError("no tilt in the views"), 1, "no tilt in the views"),
        (UsageError("give --from"), 2, "give --from"),
        (ConfigError("a.toml: x: wrong"), 3, "a.toml: x: wrong"),
        (HardwareError("serial port busy"), 4, "serial port busy"),
        (DeviceLostError("main camera is gone", "main"), 4, "main camera is gone"),
        (FrameSetError("frames.csv:3: bad time"), 4, "frames.csv:3: bad time"),
        (OSError(errno.ENOSPC, "No space left on device", "/x"), 4, "/x: No space left on device"),
        (DatabaseNewerError("made by 9.0"), 5, "made by 9.0"),
        (sqlite3.OperationalError("disk I/O error"), 5, "disk I/O error"),
        (ZeroDivisionError("by zero"), 1, "internal error: ZeroDivisionError: by zero"),
        (KeyboardInterrupt(), 1, "interrupted"),
        (DcamError("two\nlines"), 1, "two lines"),
    ],
)
def test_error_is_one_line_and_its_code(error, code: int, text: str, capsys) -> None:
    assert run_raising(error) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert line.startswith(f"dcam-test: error: {text}")


def test_errors_about_files_say_what_to_do(tmp_path, capsys) -> None:
    (tmp_path / "file").touch()
    missing, below = tmp_path / "no" / "set", tmp_path / "file" / "x"
    cures = {
        missing: "No such file or directory; there is no directory",
        tmp_path / "x": "No such file or directory; check its name",
        tmp_path: "Is a directory; it is a directory: name a file",
        below: f"Not a directory; {tmp_path / 'file'} is not a directory: name another path",
    }
    for path, text in cures.items():
        with pytest.raises(OSError, match="Errno") as raised:
            path.read_bytes()
        assert run_raising(raised.value) == 4
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"dcam-test: error: {path}: {text}")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_a_file_of_another_user_names_the_user_to_be(tmp_path) -> None:
    """From outside: the command as a user who may not read the state of somebody else."""
    folder = tmp_path / "state"
    folder.mkdir(mode=0o700)
    os.chown(folder, pwd.getpwnam("daemon").pw_uid, -1)
    for place in (tmp_path, *tmp_path.parents):
        if place.owner() == "root" and place != Path(tempfile.gettempdir()):
            place.chmod(place.stat().st_mode | 0o055)
        if place == Path(tempfile.gettempdir()):
            break
    code = (
        "import os, sys; from daemon.file_errors import file_error_text\n"
        "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "try: open(sys.argv[1])\nexcept OSError as error: print(file_error_text(error))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code, str(folder / "dcam.db")],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "Permission denied; nobody may not" in said
    assert "belongs to daemon: run the command as that user (sudo -u daemon ...)" in said


def test_every_problem_of_a_config_has_its_line(capsys) -> None:
    assert run_raising(ConfigError("f: a: wrong", "f: b: wrong")) == 3
    assert capsys.readouterr().err.splitlines() == [
        "dcam-test: error: f: a: wrong",
        "dcam-test: error: f: b: wrong",
    ]


def test_an_error_shows_control_characters(capsys) -> None:
    @click.command()
    def command() -> None:
        msg = "camera \x1b]0;owned\x07 is lost"
        raise DeviceLostError(msg)

    run(command, "dcam-ctl", [])
    assert capsys.readouterr().err == ("dcam-ctl: error: camera \\x1b]0;owned\\x07 is lost\n")


def test_a_matplotlib_of_the_system_beside_ours_disturbs_nobody(capsys) -> None:
    """Debian's has a folder for three dimensions that ours cannot load, and says so."""

    @click.command()
    def plot() -> None:
        warnings.warn("Unable to import Axes3D. This may be due to multiple versions", stacklevel=1)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(plot, "dcam-ctl", []) == 0
    assert capsys.readouterr().err == ""


def test_unknown_option_is_usage(capsys) -> None:
    assert run_raising(None, "--nonsense") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--nonsense" in line


def test_traceback_only_with_debug(capsys) -> None:
    assert run_raising(ValueError("deep inside"), "--debug") == 1
    assert "Traceback" in capsys.readouterr().err


def test_done_is_zero_and_a_command_may_give_its_own_code() -> None:
    assert run_raising(None) == 0

    @click.command()
    @click.pass_context
    def status(ctx: click.Context) -> None:
        ctx.exit(2)

    assert run(status, "dcam-test", []) == 2
