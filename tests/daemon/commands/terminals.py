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
from pathlib import Path

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


_SEVERAL = """
import json, sys
from daemon.ctl import cli
from daemon.error_report import run
for words in json.loads(sys.argv[1]):
    print(f"== exit code {run(cli, 'dcam-ctl', words)}", flush=True)
"""


def several(*commands: list[object]) -> list[str]:
    """A program that runs one `dcam-ctl` command after the other, for they are slow to load."""
    words = json.dumps([[str(word) for word in words] for words in commands])
    return [sys.executable, "-c", _SEVERAL, words]


def on_pipe(arguments: list[str], **more: str) -> subprocess.CompletedProcess[bytes]:
    """Run a program with both outputs on pipes."""
    return subprocess.run(
        arguments, cwd=ROOT, env=environment(**more), capture_output=True, check=False
    )


def on_terminal(columns: int, arguments: list[str], **more: str) -> str:
    """Run a program with both outputs on a terminal so many columns wide; give what it wrote."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    with subprocess.Popen(
        arguments,
        cwd=ROOT,
        env=environment(**{"TERM": "dumb", **more}),
        stdin=subprocess.DEVNULL,
        stdout=its,
        stderr=its,
    ):
        os.close(its)
        written = b""
        with contextlib.suppress(OSError):  # a terminal that nobody holds open any more
            while chunk := os.read(ours, 65536):
                written += chunk
        os.close(ours)
    return written.decode().replace("\r\n", "\n")
