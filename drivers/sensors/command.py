"""A sensor behind a program of the site's own that prints one number."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from drivers.errors import SensorError
from drivers.sensors.number import parse_number, shortened

_MOST_BYTES = 4096
"""Of what it prints; who prints more prints no number."""
_REAP_S = 1.0
"""A killed process is gone by then, unless the kernel holds it."""


class CommandSensor:
    """Runs a program, without a shell, and kills it with all that it started; a `Sensor`."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = list(command)
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False

    @property
    def bus(self) -> str:
        """The whole command: nothing else is waited for."""
        return "\0".join(self._command)

    def read(self, timeout_s: float) -> float:
        """Give the number that it prints in time. Raises SensorError."""
        ends_s = time.monotonic() + timeout_s
        name = Path(self._command[0]).name
        process = self._start()
        try:
            printed, complained = _collect(process, ends_s)
        except TimeoutError:
            msg = f"{name}: no answer within {timeout_s:g} s"
            raise SensorError(msg) from None
        finally:
            _end(process)
        if len(printed) > _MOST_BYTES:
            msg = f"{name}: prints more than a number"
            raise SensorError(msg)
        code = process.returncode
        if code != 0:
            text = shortened(complained.decode("utf-8", "replace"))
            msg = f"{name}: ended with code {code}" + (f" ({text})" if text else "")
            raise SensorError(msg)
        try:
            return parse_number(printed.decode("utf-8", "replace"))
        except SensorError as error:
            msg = f"{name}: {error}"
            raise SensorError(msg) from None

    def stop(self) -> None:
        """Kill it if it runs, and start it no more."""
        with self._lock:
            self._stopped = True
            if self._process is not None and self._process.returncode is None:
                _kill(self._process)

    def _start(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._stopped:
                msg = "stopped"
                raise SensorError(msg)
            if self._process is not None and self._process.poll() is None:
                msg = "the program before was killed and has not ended"
                raise SensorError(msg)
            try:
                self._process = subprocess.Popen(  # noqa: S603 - the site's own program
                    self._command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    start_new_session=True,
                )
            except OSError as error:
                msg = f"{self._command[0]}: cannot be started ({error.strerror})"
                raise SensorError(msg) from None
            return self._process


def _collect(process: subprocess.Popen[bytes], ends_s: float) -> tuple[bytes, bytes]:
    """What it prints and what it complains, until it ends or prints too much.

    The process is not reaped: its number is still its own. Raises TimeoutError.
    """
    pipes: list[IO[bytes]] = [pipe for pipe in (process.stdout, process.stderr) if pipe]
    texts = {pipe.fileno(): b"" for pipe in pipes}
    out = pipes[0].fileno()
    end = os.pidfd_open(process.pid)
    try:
        with selectors.DefaultSelector() as selector:
            for descriptor in (*texts, end):
                selector.register(descriptor, selectors.EVENT_READ)
            has_ended = False
            while not has_ended and len(texts[out]) <= _MOST_BYTES:
                left_s = ends_s - time.monotonic()
                ready = {key.fd for key, _ in selector.select(left_s)} if left_s > 0 else set()
                if not ready:
                    raise TimeoutError
                has_ended = end in ready
                for descriptor in ready - {end}:
                    data = os.read(descriptor, _MOST_BYTES)
                    texts[descriptor] = (texts[descriptor] + data)[: _MOST_BYTES + 1]
                    if not data:
                        selector.unregister(descriptor)
            for descriptor in {key.fd for key, _ in selector.select(0)} - {end}:
                texts[descriptor] += os.read(descriptor, _MOST_BYTES)
    finally:
        os.close(end)
    printed, complained = texts.values()
    return printed, complained


def _end(process: subprocess.Popen[bytes]) -> None:
    """Leave nothing behind: no process of its session, no zombie, no open pipe."""
    _kill(process)
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(_REAP_S)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill its session; what it started may live on after it has ended itself."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
