"""Our programs, each a process of its own, forked from one that has loaded the libraries.

To load them takes two seconds, and what is asked of a program here is what it does after that.
Tests of the start itself (what is loaded, options of Python, another user, strace) start Python.
"""

from __future__ import annotations

import ctypes
import fcntl
import multiprocessing
import os
import runpy
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from functools import cache
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext
from pathlib import Path
from subprocess import PIPE
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self, TextIO

import pytest

from tests.waiting import PATIENCE_S, wait_for

ROOT = Path(__file__).parents[1]
PRELOADED = ["tests.loaded", "tests.programs"]
"""What a process has loaded that programs are forked from."""

Stream = Path | Connection | int | None
"""A file that output is added to, an open one (which is closed here), PIPE for a pipe to the test,
or None: it is lost."""


class Program:
    """A program that runs; its methods are those of `subprocess.Popen`."""

    def __init__(
        self,
        module: str | Path,
        *arguments: object,
        env: Mapping[str, str] | None = None,
        stdin: Connection | int | None = None,
        stdout: Stream = None,
        stderr: Stream = None,
        stopped: bool = False,
        kept: Sequence[int] = (),
    ) -> None:
        """Start it as `python -m MODULE ARGUMENTS` would be; a path as `python PATH ARGUMENTS`.

        One that is stopped begins when it gets SIGCONT: until then a tracer can attach. Open files
        that are kept have the same numbers in it.
        """
        self.args = [str(module), *map(str, arguments)]
        self.stdin, its_in = _pipe_to() if stdin == PIPE else (None, stdin)
        self.stdout, its_out = _pipe_from(stdout)
        self.stderr, its_err = _pipe_from(stderr)
        streams = (its_in, its_out, its_err)
        files = dict(enumerate(streams)) | {n: Connection(os.dup(n)) for n in kept}
        network = Path(f"/proc/{os.getpid()}/task/{threading.get_native_id()}/ns/net")
        self._process = _server().Process(
            target=_be,
            args=(self.args, dict(os.environ if env is None else env), files, network, stopped),
            daemon=True,  # none outlives the tests
        )
        self._process.start()
        for end in files.values():
            if isinstance(end, Connection):
                end.close()
        if stopped:
            self.wait_until_stopped()

    def wait_until_stopped(self) -> None:
        wait_for(lambda: _state(self.pid) == "T", "the program to stop")

    @property
    def pid(self) -> int:
        number = self._process.pid
        assert number is not None
        return number

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float = PATIENCE_S) -> int:
        if not wait([self._process.sentinel], timeout):
            raise subprocess.TimeoutExpired(self.args, timeout)
        self._process.join()
        code = self.returncode
        assert code is not None
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self._process.terminate()

    def kill(self) -> None:
        self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream is not None:
                stream.close()
        self.wait()


def ran(
    module: str | Path,
    *arguments: object,
    env: Mapping[str, str] | None = None,
    timeout: float = PATIENCE_S,
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, and give what it said."""
    with TemporaryDirectory() as directory:
        stdout, stderr = Path(directory) / "stdout", Path(directory) / "stderr"
        program = Program(module, *arguments, env=env, stdout=stdout, stderr=stderr)
        try:
            code = program.wait(timeout)
        finally:
            program.kill()
        return subprocess.CompletedProcess(
            program.args, code, stdout.read_text(), stderr.read_text()
        )


class Forked:
    """Stands in for `subprocess` in what starts our programs as `python -m MODULE ARGUMENTS`."""

    PIPE, DEVNULL, TimeoutExpired = PIPE, None, subprocess.TimeoutExpired

    @staticmethod
    def Popen(
        command: Sequence[object],
        *,
        stderr: Stream = None,
        pass_fds: Sequence[int] = (),
        **_: object,
    ) -> Program:
        _python, _m, module, *arguments = command
        return Program(str(module), *arguments, stderr=stderr, kept=pass_fds)

    @staticmethod
    def run(command: Sequence[object], **_: object) -> subprocess.CompletedProcess[str]:
        _python, _m, module, *arguments = command
        return ran(str(module), *arguments)


def traced(options: Sequence[str], module: str, *arguments: object, stderr: Stream = None) -> int:
    """How a program ends that runs with strace attached from its beginning."""
    require_strace()
    with Program(module, *arguments, stderr=stderr, stopped=True) as program:
        command = ["strace", "-f", *options, "-p", str(program.pid)]
        with subprocess.Popen(command, stderr=PIPE, text=True) as strace:
            said = strace.stderr.readline()
            program.send_signal(signal.SIGCONT)
            code = program.wait()
    require_attached(said)
    return code


def require_strace() -> None:
    """Skip the test where there is none."""
    if not shutil.which("strace"):
        pytest.skip("strace is not installed")


def require_attached(said: str) -> None:
    """Skip the test where strace, by the first line that it said, may not trace."""
    if "attached" not in said:
        pytest.skip(f"strace may not trace here: {said}")


def _state(pid: int) -> str:
    """Of a process, as ps tells it."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]


@cache
def _server() -> ForkServerContext:
    """The process that has loaded everything, one for each process of the tests."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


def _pipe_to() -> tuple[TextIO, Connection]:
    """A pipe to a program: our end, and its."""
    its, ours = os.pipe()
    return os.fdopen(ours, "w"), Connection(its, writable=False)


def _pipe_from(stream: Stream) -> tuple[TextIO | None, Path | Connection | None]:
    """A pipe from a program, if one is asked for: our end, and its."""
    if isinstance(stream, int):
        ours, its = os.pipe()
        return os.fdopen(ours, "r"), Connection(its, readable=False)
    if isinstance(stream, Path):
        stream.touch()  # whoever waits for what it says may look at once
    return None, stream


def _be(
    words: list[str],
    environment: dict[str, str],
    files: Mapping[int, Path | Connection | None],
    network: Path,
    stopped: bool,
) -> None:
    """Become the program: in a fresh fork, with the output, environment and network of a test."""
    if network.readlink() != Path("/proc/self/ns/net").readlink():
        with network.open() as namespace:
            assert ctypes.CDLL(None).setns(namespace.fileno(), 0) == 0
    least = 1 + max(files)  # out of the way of every number that is wanted
    places = {number: _opened(stream, least) for number, stream in files.items()}
    for number, place in places.items():
        os.dup2(place, number)
        os.close(place)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - as Python itself opens them
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environment)
    time.tzset()
    os.chdir(ROOT)
    sys.argv = words
    if stopped:
        os.kill(os.getpid(), signal.SIGSTOP)
    if words[0].endswith(".py"):
        runpy.run_path(words[0], run_name="__main__")
    else:
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)


def _opened(stream: Path | Connection | None, least: int) -> int:
    """The number of the open stream, not below the least."""
    if isinstance(stream, Connection):
        place = os.dup(stream.fileno())
        stream.close()
    else:
        place = os.open(stream or os.devnull, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    above = fcntl.fcntl(place, fcntl.F_DUPFD, least)
    os.close(place)
    return above
