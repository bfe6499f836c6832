"""Commands as programs of their own: on a terminal of some width, on a pipe, in a locale."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
from multiprocessing.connection import Connection
from pathlib import Path

from tests.programs import Program, ran

ROOT = Path(__file__).parents[3]
ASCII_LOCALE = {
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONCOERCECLOCALE": "0",
    "PYTHONIOENCODING": "ascii",
}
"""As under cron or an old shell: ASCII, and a sign that is none is an error."""


def program(*words: object, module: str = "daemon.ctl") -> list[str]:
    """The command line of `dcam-ctl`, or of another of our programs."""
    return [sys.executable, "-m", module, *map(str, words)]


def environment(**more: str) -> dict[str, str]:
    """This process's environment without what decides the shape of output."""
    decides = {"COLUMNS", "LINES", "FORCE_COLOR", "NO_COLOR", "DCAM_CONFIG", "DCAM_STATE"}
    return {**{k: v for k, v in os.environ.items() if k not in decides}, **more}


def several(*commands: list[object]) -> list[str]:
    """A program that runs one `dcam-ctl` command after the other."""
    words = json.dumps([[str(word) for word in words] for words in commands])
    return program(words, module="tests.daemon.commands.several")


def on_pipe(arguments: list[str], **more: str) -> subprocess.CompletedProcess[bytes]:
    """Run a program with both outputs on pipes.

    It is forked from one that is loaded, but for another locale: Python asks for that at its start.
    """
    if "LC_ALL" not in more:
        _python, _m, *words = arguments
        done = ran(*words, env=environment(**more))
        said = done.stdout.encode(), done.stderr.encode()
        return subprocess.CompletedProcess(arguments, done.returncode, *said)
    return subprocess.run(
        arguments, cwd=ROOT, env=environment(**more), capture_output=True, check=False
    )


def on_terminal(columns: int, arguments: list[str], **more: str) -> str:
    """Run a program with both outputs on a terminal so many columns wide; give what it wrote."""
    ours, its = terminal(columns)
    with started_on(its, arguments, **{"TERM": "dumb", **more}):
        return all_of(ours)


def terminal(columns: int, lines: int = 24) -> tuple[int, int]:
    """Our end of a terminal, and its."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    return ours, its


def started_on(
    its: int, arguments: list[str], *, reads: bool = False, **more: str
) -> Program | subprocess.Popen[bytes]:
    """Start a program on a terminal, which is closed here; in a locale as `on_pipe` says."""
    env = environment(**more)
    if "LC_ALL" not in more:
        _python, _m, *words = arguments
        stdin = Connection(os.dup(its)) if reads else None
        outputs = {"stdout": Connection(os.dup(its)), "stderr": Connection(its)}
        return Program(*words, env=env, stdin=stdin, **outputs)
    started = subprocess.Popen(
        arguments, cwd=ROOT, env=env, stdin=subprocess.DEVNULL, stdout=its, stderr=its
    )
    os.close(its)
    return started


def all_of(ours: int, written: bytes = b"") -> str:
    """What is written on a terminal until nobody holds its other end any more; it is closed."""
    with contextlib.suppress(OSError):  # so it says that
        while chunk := os.read(ours, 65536):
            written += chunk
    os.close(ours)
    return written.decode().replace("\r\n", "\n")
