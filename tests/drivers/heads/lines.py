"""Lines to simulated heads: one straight to the machine in its own time, one over a real port."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.errors import HeadLostError
from drivers.protocols import HeadSettings, PanTiltHead
from drivers.sim.head_machine import Faults, FaultyHead, HeadMachine
from drivers.sim.head_server import HeadServer

STEP_S = 0.005
SETTINGS = HeadSettings(answer_timeout_s=0.3, move_timeout_s=30.0)


class MachineLine:
    """A `drivers.heads.serial_line.Line` straight to a machine; reading is what lets time pass."""

    name = "the line"

    def __init__(self, machine: HeadMachine) -> None:
        self.machine = machine
        self.sent: list[bytes] = []
        self.now_s = 0.0
        self.openings = 0
        self.plugged = True
        self.on_read: Callable[[], object] = lambda: None
        """What else happens while the line is listened to; may raise."""
        self._open = False
        self._heard = b""

    def monotonic_s(self) -> float:
        return self.now_s

    def open(self) -> None:
        if not self.plugged:
            self._open = False
            msg = "the line: no such port"
            raise HeadLostError(msg)
        if not self._open:
            self._open, self._heard = True, b""
            self.openings += 1

    def write(self, data: bytes) -> None:
        self._require()
        self.sent.append(data)
        self._heard += self.machine.receive(data, self.now_s)

    def read(self, timeout_s: float) -> bytes:
        self._require()
        self.on_read()
        self._require()
        until_s = self.now_s + timeout_s
        self._heard += self.machine.advance(self.now_s)
        while not self._heard and self.now_s < until_s:
            self.now_s = min(self.now_s + STEP_S, until_s)
            self._heard += self.machine.advance(self.now_s)
        heard, self._heard = self._heard, b""
        return heard

    def close(self) -> None:
        self._open = False

    def _require(self) -> None:
        if not (self.plugged and self._open):
            self._open = False
            msg = "the line: the port has vanished"
            raise HeadLostError(msg)


class Recorder:
    """A machine, and all that it ever received; implements `HeadMachine`."""

    def __init__(self, machine: HeadMachine) -> None:
        self._machine = machine
        self.received = b""

    @property
    def commands(self) -> int:
        return self._machine.commands

    def receive(self, data: bytes, now_s: float) -> bytes:
        self.received += data
        return self._machine.receive(data, now_s)

    def advance(self, now_s: float) -> bytes:
        return self._machine.advance(now_s)

    def angles_deg(self, now_s: float) -> tuple[float, float]:
        return self._machine.angles_deg(now_s)


@dataclass
class Bench:
    """A head as its users see it, and what its test can see and do behind its back."""

    head: PanTiltHead
    settings: HeadSettings
    count_deg: float
    """What it can come near to an angle asked for."""
    angles_deg: Callable[[], tuple[float, float]]
    """Where it truly is."""
    has_received: Callable[[], bytes] | None = None
    """All bytes that reached it; None for a head without a line."""
    stop_bytes: bytes = b""
    set_faults: Callable[..., None] | None = None
    replug: Callable[[], None] | None = None
    unplug: Callable[[], None] | None = None


class PortBench:
    """A simulated head on a port, which can be taken away and come back with a new machine."""

    def __init__(self, make: Callable[[], HeadMachine], link: Path, speed_factor: float) -> None:
        self._make = make
        self._link = link
        self._speed_factor = speed_factor
        self.server: HeadServer | None = None
        self.plug()

    def plug(self) -> None:
        self.recorder = Recorder(self._make())
        self.faulty = FaultyHead(self.recorder, Faults())
        self.server = HeadServer(self.faulty, link=self._link, speed_factor=self._speed_factor)
        self.server.__enter__()

    def unplug(self) -> None:
        if self.server is not None:
            self.server.close()
            self.server = None

    def angles_deg(self) -> tuple[float, float]:
        assert self.server is not None
        return self.server.angles_deg()

    def set_faults(self, **changes: float) -> None:
        self.faulty.faults = replace(self.faulty.faults, **changes)

    def bench(
        self, head: PanTiltHead, settings: HeadSettings, count_deg: float, stop: bytes
    ) -> Bench:
        return Bench(
            head,
            settings,
            count_deg,
            self.angles_deg,
            has_received=lambda: self.recorder.received,
            stop_bytes=stop,
            set_faults=self.set_faults,
            replug=self.plug,
            unplug=self.unplug,
        )
