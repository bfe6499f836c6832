"""What a user reads when something fails: one line, and an exit code for scripts."""

from __future__ import annotations

import os
import sqlite3
import sys
import traceback
import warnings
from collections.abc import Sequence

import click

from core.errors import CoreError
from daemon.errors import ConfigError, DcamError, ExitCode
from daemon.file_errors import file_error_text
from daemon.text import visible, write_readably
from drivers.errors import DriverError

_FOREIGN_EXIT_CODES: tuple[tuple[type[BaseException], ExitCode], ...] = (
    (click.UsageError, ExitCode.USAGE),
    (DriverError, ExitCode.HARDWARE),
    (CoreError, ExitCode.FAILED),
    (sqlite3.Error, ExitCode.DATABASE),
    (OSError, ExitCode.HARDWARE),
)
"""Errors of other layers and of libraries; the first match counts. Ours own their exit codes."""


def exit_code_of(error: BaseException) -> ExitCode:
    """Give the exit code of an error; of an unexpected one it is 1."""
    if isinstance(error, DcamError):
        return error.exit_code
    codes = (code for kind, code in _FOREIGN_EXIT_CODES if isinstance(error, kind))
    return next(codes, ExitCode.FAILED)


def lines_of(error: BaseException) -> tuple[str, ...]:
    """Give what the user reads: one line, or one for each problem of a config."""
    if isinstance(error, ConfigError):
        return error.problems
    if isinstance(error, click.UsageError):
        text = f"{_usage_text(error)}; see --help"
    elif isinstance(error, click.ClickException):
        text = error.format_message()
    elif isinstance(error, KeyboardInterrupt | click.Abort):
        text = "interrupted"
    elif isinstance(error, OSError) and error.strerror:
        text = file_error_text(error)
    elif _is_ours(error):
        text = str(error)
    else:
        text = f"internal error: {type(error).__name__}: {error} (--debug shows where)"
    return (" ".join(text.split()),)


def _usage_text(error: click.UsageError) -> str:
    # From click 8.2 a group called without a command raises its whole help page.
    if type(error).__name__ == "NoArgsIsHelpError":
        return "no command given"
    return error.format_message().rstrip(".")


def _is_ours(error: BaseException) -> bool:
    return isinstance(error, DcamError) or any(
        isinstance(error, kind) for kind, _ in _FOREIGN_EXIT_CODES
    )


def report(error: BaseException, program: str, *, debug: bool) -> ExitCode:
    """Print on stderr what went wrong, and give the exit code."""
    if debug:
        traceback.print_exception(error, file=sys.stderr)
    for line in lines_of(error):
        print(f"{program}: error: {visible(line)}", file=sys.stderr)
    return exit_code_of(error)


def ignore_older_matplotlib() -> None:
    """Hide that ours cannot draw in three dimensions beside an older one of the system."""
    warnings.filterwarnings("ignore", "Unable to import Axes3D", UserWarning)


def run(command: click.Command, program: str, arguments: Sequence[str] | None = None) -> int:
    """Run a click command and give its exit code; the one place where errors become text.

    A command ends with another code than 0 by raising, by returning an int, or by `ctx.exit`.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    write_readably()
    ignore_older_matplotlib()
    try:
        result = command.main(args=argv, prog_name=program, standalone_mode=False)
    except BrokenPipeError:
        # The reader (`| head`) went away; the interpreter must not complain of it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.FAILED
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the last place to report it
        return report(error, program, debug="--debug" in argv)
    return result if isinstance(result, int) else ExitCode.DONE
