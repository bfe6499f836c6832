"""A seeded history of faults of two cameras, played slot by slot; it knows what must come of it."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from contextlib import contextmanager
from datetime import datetime

import pytest

from daemon.store.records import GapCause
from drivers import pair
from drivers.clock import SteppedClock
from drivers.deadline import DeadlineThread
from drivers.pair import SynchronizedPair
from drivers.protocols import CapturedPair
from tests.faults.cameras import CALLS, ENDED_S, ERRORS, GARBAGE, SIZE, Fault, FaultyCamera

FOR_EVER = 40
"""Slots that a call hangs which nobody expects to return any more."""


class Trouble:
    """One camera's faults, one after the other."""

    def __init__(self, camera: FaultyCamera, seed: int) -> None:
        self.camera = camera
        self.begun = 0
        self.kinds: set[str] = set()
        self._random = random.Random(seed)
        self._left = 0
        """Slots until what is now comes to an end."""

    def next_slot(self, lane: pair._Lane, *, more: bool) -> None:
        """Go on to the next slot: what is now may end, and something else begin."""
        self._left -= 1
        if self._left > 0:
            return
        ended = self.camera.fault is not None
        self.camera.release()
        _wait_for_the_one_left_behind(lane)
        if more and self._random.random() < (0.4 if ended else 0.75):
            self.camera.fault = self._fault()
            self.begun += 1
            self.kinds.add(self.camera.fault.kind)
            self.kinds.add(f"{self.camera.fault.on_close} on close")
        else:
            self._left = self._random.randint(1, 2)

    def _fault(self) -> Fault:
        draw = self._random
        self._left = draw.choice([1, 1, 1, 2, 4])
        kind = draw.choice([*ERRORS, *GARBAGE, "lost", "lost", "hang", "hang", "hang", "stale"])
        if kind == "hang" and draw.random() < 0.03:
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
            for lane in self.pair._lanes:
                _settle(lane)

    def _begin(self, slot_utc: datetime) -> None:
        self.on_slot(len(self.expected))
        for trouble, lane in zip(self.troubles, self.pair._lanes, strict=True):
            trouble.next_slot(lane, more=self.begun < self._faults)
        if self._random.random() < 0.02:  # somebody else has had the cameras meanwhile
            self.pair.close()
        faults = [camera.fault for camera in self.cameras if camera.fault is not None]
        self.expected[slot_utc] = set().union(*(fault.causes for fault in faults))
        self.shown[slot_utc] = tuple(camera.fault for camera in self.cameras)

    def start_anew(self) -> None:
        """The process has ended, and with it whatever hung in it: another one begins."""
        self.close()
        for lane in self.pair._lanes:
            _wait_for_the_one_left_behind(lane)
            lane._camera.start_anew()
        self.pair = self._pair()

    def _pair(self) -> SynchronizedPair:
        size = SIZE[::-1]
        return SynchronizedPair(*self.cameras, self._clock, sizes_px=(size, size))

    def close(self) -> None:
        for trouble in self.troubles:
            trouble.camera.release()
        self.pair.close()


@contextmanager
def deadlines_without_waiting(monkeypatch: pytest.MonkeyPatch):
    """A deadline is over as soon as the camera hangs, and not before: no luck, and no waiting."""
    finish, end = pair._Lane.finish, DeadlineThread.end

    def finish_at_once(lane, future, what, timeout_s, _deadline_s):
        future.add_done_callback(lane._camera.notify)
        lane._camera.wait_for(future.done)
        return finish(lane, future, what, timeout_s, 0.0)

    def end_at_once(thread, wait_s=0.0):
        end(thread)
        camera = thread._at_end.__self__._camera
        while wait_s and thread.alive and not camera._hanging:
            thread._thread.join(0.001)

    with monkeypatch.context() as patched:
        patched.setattr(pair._Lane, "finish", finish_at_once)
        patched.setattr(DeadlineThread, "end", end_at_once)
        yield


def _settle(lane: pair._Lane) -> None:
    """Let the camera's thread come to the end of what it was told, or hang in it."""
    if lane._thread is not None:
        future = lane._thread.submit(lambda: None)
        future.add_done_callback(lane._camera.notify)
        lane._camera.wait_for(future.done)


def _wait_for_the_one_left_behind(lane: pair._Lane) -> None:
    """Its call has returned: it closes the camera and ends, before the next slot comes."""
    if lane._left_behind is not None:
        thread: threading.Thread = lane._left_behind._thread
        thread.join(ENDED_S)
        assert not thread.is_alive()
