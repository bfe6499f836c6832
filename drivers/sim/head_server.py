"""A simulated head on a pseudo-terminal: a thin loop around the pure machine."""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from drivers.sim.head_angles import AnglesGiver
from drivers.sim.head_machine import HeadMachine

TICK_S = 0.005
"""How late a message that nobody asked for may come."""


class HeadServer:
    """Serves one head on a port of its own; `serve` in any thread, `stop` from any other.

    The head lives `speed_factor` times as fast as the clock. With `link` the port has a stable
    name; with `angles` a Unix socket tells where the head truly is.
    """

    def __init__(
        self,
        machine: HeadMachine,
        *,
        link: Path | None = None,
        angles: Path | None = None,
        speed_factor: float = 1.0,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._machine = machine
        self._factor = speed_factor
        self._monotonic_s = monotonic_s
        self._start_s = monotonic_s()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._giver = AnglesGiver(angles) if angles else None
        # The other end is kept open too, else the head would hang up with its first client.
        self._head_end, self._port_end = pty.openpty()
        tty.setraw(self._port_end)
        os.set_blocking(self._head_end, False)
        self._port = Path(os.ttyname(self._port_end))
        self._link = link
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self._port)

    @property
    def port(self) -> Path:
        """What a client opens."""
        return self._link or self._port

    def angles_deg(self) -> tuple[float, float]:
        """Where pan and tilt truly are, now."""
        return self._machine.angles_deg(self._now_s())

    def serve(self) -> None:
        """Serve until `stop`."""
        while not self._stop.is_set():
            watched: list[int | AnglesGiver] = [self._head_end]
            if self._giver is not None:
                watched.append(self._giver)
            ready, _, _ = select.select(watched, [], [], TICK_S)
            if self._giver is not None and self._giver in ready:
                self._giver.answer(self.angles_deg())
            if self._head_end in ready:
                with suppress(OSError):
                    data = os.read(self._head_end, 4096)
                    self._say(self._machine.receive(data, self._now_s()))
            self._say(self._machine.advance(self._now_s()))

    def stop(self) -> None:
        """Let `serve` return within a tick."""
        self._stop.set()

    def close(self) -> None:
        """Take the port away; a client that has it open loses it."""
        self.stop()
        if self._thread is not None:
            self._thread.join()
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        if self._giver is not None:
            self._giver.close()
        for end in (self._port_end, self._head_end):
            with suppress(OSError):
                os.close(end)

    def __enter__(self) -> Self:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self.serve, name="simulated-head", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Take the port away."""
        self.close()

    def _now_s(self) -> float:
        return (self._monotonic_s() - self._start_s) * self._factor

    def _say(self, answer: bytes) -> None:
        if answer:
            with suppress(BlockingIOError):  # nobody reads: a real head does not wait either
                os.write(self._head_end, answer)
