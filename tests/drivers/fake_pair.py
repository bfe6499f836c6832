"""Two cameras that do as a test asks, and the pair that they make."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

import numpy as np
import pytest

from drivers.clock import SteppedClock
from drivers.errors import DeviceError
from drivers.pair import SynchronizedPair
from drivers.protocols import CapturedFrame
from tests.drivers.hang import Hang, ImpatientThread

SLOT = datetime(2026, 3, 1, tzinfo=UTC)
PIXELS = np.zeros((4, 6), np.uint8)


class FakeCamera:
    """A camera that does as asked: `on` maps a call's name to what happens in it."""

    def __init__(self, serial: str, trigger_s: float = 0.0) -> None:
        self.serial = serial
        self.is_lost = False
        self.trigger_s = trigger_s
        self.calls: list[str] = []
        self.exposures: list[tuple[float, float | None]] = []
        self.threads: set[int] = set()
        self.hang = Hang()
        self.on: dict[str, Callable[[], None]] = {}
        self.give: object = ...
        """What fetch gives; ...: a new frame."""

    def _called(self, name: str) -> None:
        self.calls.append(name)
        self.threads.add(threading.get_ident())
        self.on.get(name, lambda: None)()

    def open(self) -> None:
        self._called("open")

    def set_exposure(self, exposure_us: float, gain_db: float | None) -> None:
        self.exposures.append((exposure_us, gain_db))
        self._called("set_exposure")

    def arm(self) -> None:
        self._called("arm")

    def trigger(self) -> None:
        self._called("trigger")

    def fetch(self, timeout_s: float) -> CapturedFrame:
        self._called("fetch")
        if self.give is not ...:
            return self.give
        return CapturedFrame(PIXELS, 8, self.calls.count("trigger"), 0, self.trigger_s)

    def close(self) -> None:
        self._called("close")


def fails_with(error: Exception) -> Callable[[], None]:
    def raise_it() -> None:
        raise error

    return raise_it


class Rig:
    """Two fake cameras, a stepped clock and their pair."""

    def __init__(self) -> None:
        self.main, self.sub = FakeCamera("M1", 7.0), FakeCamera("S1", 7.25)
        self.clock = SteppedClock(SLOT)
        self.pair = SynchronizedPair(
            self.main,
            self.sub,
            self.clock,
            sizes_px=((6, 4), (6, 4)),
            make_thread=self._make_thread,
        )
        self._threads: list[ImpatientThread] = []

    def _make_thread(self, name: str, at_end: Callable[[], None]) -> ImpatientThread:
        hang = (self.sub if name.startswith("sub") else self.main).hang
        self._threads.append(ImpatientThread(name, at_end, hang))
        return self._threads[-1]

    def fail(self) -> DeviceError:
        """Capture, which must fail."""
        with pytest.raises(DeviceError) as caught:
            self.pair.capture(SLOT)
        return caught.value

    def let_go(self) -> None:
        """Let what hangs return, and the threads that were left behind in it end."""
        self.main.hang.release()
        self.sub.hang.release()
        for thread in self._threads:
            if thread.ended:
                thread.wait_for_end()


@contextmanager
def fake_rig() -> Iterator[Rig]:
    """A rig whose threads have ended when its test has."""
    rig = Rig()
    yield rig
    rig.let_go()
    rig.pair.close()
