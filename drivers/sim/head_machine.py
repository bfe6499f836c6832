"""What a simulated head looks like to its port, and the faults that any head can have."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class HeadMachine(Protocol):
    """A head as a pure machine: bytes in, bytes out, at the times that it is given."""

    @property
    def commands(self) -> int:
        """How many commands it has taken so far."""
        ...

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes; give what it answers at once."""
        ...

    def advance(self, now_s: float) -> bytes:
        """Let time pass; give what it says by now: an answer that had to wait, a message."""
        ...

    def angles_deg(self, now_s: float) -> tuple[float, float]:
        """Where pan and tilt truly are."""
        ...


@dataclass(frozen=True, slots=True)
class Faults:
    """What may be wrong with the line or the controller of a head; by default nothing."""

    latency_s: float = 0.0
    """Every answer comes so late."""
    noise: float = 0.0
    """Share of answers that a burst of random bytes comes before."""
    silent_after: int | None = None
    """Says nothing more after so many commands, but goes on moving."""
    nonsense_after: int | None = None
    """Answers with random bytes after so many commands."""
    seed: int = 1


class FaultyHead:
    """A head machine behind a faulty line; implements `HeadMachine`."""

    def __init__(self, machine: HeadMachine, faults: Faults) -> None:
        self._machine = machine
        self.faults = faults
        """May be changed while it runs."""
        self._rng = np.random.default_rng(faults.seed)
        self._on_the_way: deque[tuple[float, bytes]] = deque()

    @property
    def commands(self) -> int:
        """How many commands it has taken so far."""
        return self._machine.commands

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes; give what comes through by now."""
        self._send(self._machine.receive(data, now_s), now_s)
        return self._arrived(now_s)

    def advance(self, now_s: float) -> bytes:
        """Let time pass; give what comes through by now."""
        self._send(self._machine.advance(now_s), now_s)
        return self._arrived(now_s)

    def angles_deg(self, now_s: float) -> tuple[float, float]:
        """Where pan and tilt truly are."""
        return self._machine.angles_deg(now_s)

    def _send(self, answer: bytes, now_s: float) -> None:
        faults = self.faults
        if not answer or _is_past(faults.silent_after, self.commands):
            return
        if _is_past(faults.nonsense_after, self.commands):
            answer = self._rng.bytes(len(answer)) + b"\r\n"
        elif self._rng.random() < faults.noise:
            answer = self._rng.bytes(int(self._rng.integers(1, 6))) + answer
        self._on_the_way.append((now_s + faults.latency_s, answer))

    def _arrived(self, now_s: float) -> bytes:
        heard = b""
        while self._on_the_way and self._on_the_way[0][0] <= now_s:
            heard += self._on_the_way.popleft()[1]
        return heard


def _is_past(after: int | None, commands: int) -> bool:
    return after is not None and commands > after
