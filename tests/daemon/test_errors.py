"""Every error becomes one line on stderr and the exit code that scripts rely on."""

import errno
import sqlite3

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


def test_every_problem_of_a_config_has_its_line(capsys) -> None:
    assert run_raising(ConfigError("f: a: wrong", "f: b: wrong")) == 3
    assert capsys.readouterr().err.splitlines() == [
        "dcam-test: error: f: a: wrong",
        "dcam-test: error: f: b: wrong",
    ]


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
