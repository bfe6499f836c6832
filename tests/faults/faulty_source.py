"""A seeded history of faults of two cameras, played slot by slot; it knows what must come of it."""

from __future__ import annotations

import random
from collections.abc import Callable
from datetime import datetime

from daemon.store.records import GapCause
from drivers.clock import SteppedClock
from drivers.pair import SynchronizedPair
from drivers.protocols import CapturedPair
from tests.drivers.hang import ImpatientThread
from tests.faults.cameras import CALLS, ERRORS, GARBAGE, SIZE, Fault, FaultyCamera

FOR_EVER = 40
"""Slots that a call hangs which nobody expects to return any more."""


class Trouble:
    """One camera's faults, one after the other."""

    def __init__(self, camera: FaultyCamera, seed: int) -> None:
        self.camera = camera
        self.begun = 0
        self.kinds: set[str] = set()
        self.threads: list[ImpatientThread] = []
        """The camera's, the last one in use unless it was given up."""
        self._random = random.Random(seed)
        self._left = 0
        """Slots until what is now comes to an end."""

    def next_slot(self, *, more: bool) -> None:
        """Go on to the next slot: what is now may end, and something else begin."""
        self._left -= 1
        if self._left > 0:
            return
        ended = self.camera.fault is not None
        self.camera.release()
        self.bury()
        if more and self._random.random() < (0.4 if ended else 0.75):
            self.camera.fault = self._fault()
            self.begun += 1
            self.kinds.add(self.camera.fault.kind)
            self.kinds.add(f"{self.camera.fault.on_close} on close")
        else:
            self._left = self._random.randint(1, 2)

    def make_thread(self, name: str, at_end: Callable[[], None]) -> ImpatientThread:
        """A thread for the camera."""
        self.threads.append(ImpatientThread(name, at_end, self.camera.hang))
        return self.threads[-1]

    def settle(self) -> None:
        """Let the thread in use come to the end of its calls, or hang in one."""
        if self.threads and not self.threads[-1].ended:
            self.threads[-1].settle()

    def bury(self) -> None:
        """Wait for the threads that were given up: their calls return, they close the camera."""
        for thread in self.threads:
            if thread.ended:
                thread.wait_for_end()
        self.threads = [thread for thread in self.threads if thread.alive]

    def _fault(self) -> Fault:
        draw = self._random
        self._left = draw.choice([1, 1, 1, 2, 4])
        kind = draw.choice([*ERRORS, *GARBAGE, "lost", "lost", "hang", "hang", "hang", "stale"])
        if kind == "hang" and draw.random() < 0.08:
            self._left = FOR_EVER
            self.kinds.add("hang for ever")
        at = draw.choice(CALLS) if kind in ERRORS or kind == "hang" else "fetch"
        return Fault(kind, at, draw.choice(["", "", "raise", "hang"]))


class FaultySource:
    """The real pair of two faulty cameras, and before each slot their next faults."""

    def __init__(self, clock: SteppedClock, seed: int, faults: int) -> None:
        self.cameras = [FaultyCamera(f"C{number}", clock) for number in (1, 2)]
        self.troubles = [Trouble(camera, seed + i) for i, camera in enumerate(self.cameras)]
        self._clock = clock
        self.pair = self._pair()
        self.expected: dict[datetime, set[GapCause]] = {}
        """Causes that a slot's gap may have; none: it must have a row."""
        self.shown: dict[datetime, tuple[Fault | None, ...]] = {}
        """The faults of the cameras at a slot."""
        self.on_slot: Callable[[int], None] = lambda _: None
        self._faults = faults
        self._random = random.Random(seed)

    @property
    def begun(self) -> int:
        """How many faults there have been."""
        return sum(trouble.begun for trouble in self.troubles)

    @property
    def faulty(self) -> bool:
        """Whether anything is wrong now."""
        return any(camera.fault for camera in self.cameras)

    def prepare(self) -> None:
        self.pair.prepare()

    def capture(self, slot_utc: datetime) -> CapturedPair:
        if slot_utc not in self.expected:
            self._begin(slot_utc)
        try:
            return self.pair.capture(slot_utc)
        finally:
            for trouble in self.troubles:
                trouble.settle()

    def _begin(self, slot_utc: datetime) -> None:
        self.on_slot(len(self.expected))
        for trouble in self.troubles:
            trouble.next_slot(more=self.begun < self._faults)
        if self._random.random() < 0.02:  # somebody else has had the cameras meanwhile
            self.pair.close()
        faults = [camera.fault for camera in self.cameras if camera.fault is not None]
        self.expected[slot_utc] = set().union(*(fault.causes for fault in faults))
        self.shown[slot_utc] = tuple(camera.fault for camera in self.cameras)

    def restart(self) -> None:
        """The process has ended, and with it whatever hung in it: another one begins."""
        self.close()
        for trouble in self.troubles:
            trouble.bury()
            trouble.camera.restart()
        self.pair = self._pair()

    def _pair(self) -> SynchronizedPair:
        size = SIZE[::-1]
        return SynchronizedPair(
            *self.cameras, self._clock, sizes_px=(size, size), make_thread=self._make_thread
        )

    def _make_thread(self, name: str, at_end: Callable[[], None]) -> ImpatientThread:
        return self.troubles[name.startswith("sub")].make_thread(name, at_end)

    def close(self) -> None:
        for trouble in self.troubles:
            trouble.camera.release()
        self.pair.close()
