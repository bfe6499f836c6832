"""Calls that hang until a test lets them go, and deadlines that pass just then: without luck."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from drivers.deadline import DeadlineThread
from tests.waiting import PATIENCE_S


class Hang:
    """Where the calls of one camera hang."""

    def __init__(self) -> None:
        self.count = 0
        """How many calls have hung here."""
        self.on = False
        """Whether one hangs now."""
        self._changed = threading.Condition()
        self._releases = 0

    def block(self) -> None:
        """Hang until the next `release`."""
        with self._changed:
            self.on = True
            self.count += 1
            self._changed.notify_all()
            releases = self._releases
            assert self._changed.wait_for(lambda: self._releases > releases, 10 * PATIENCE_S)

    def release(self) -> None:
        """Let the call that hangs return."""
        with self._changed:
            self.on = False
            self._releases += 1
            self._changed.notify_all()

    def notify(self, _: object = None) -> None:
        """Say that something may have ended."""
        with self._changed:
            self._changed.notify_all()

    def wait_for(self, ended: Callable[[], bool]) -> None:
        """Wait until something has ended, or never will because a call hangs."""
        with self._changed:
            assert self._changed.wait_for(lambda: ended() or self.on, PATIENCE_S)


class ImpatientThread(DeadlineThread):
    """A camera's thread whose deadlines pass as soon as a call hangs, and never before."""

    def __init__(self, name: str, at_end: Callable[[], None], hang: Hang) -> None:
        self._hang = hang
        self._last: Future[Any] | None = None
        self.ended = False
        """Whether it was given up; it may hang still."""
        super().__init__(name, at_end)

    def submit(self, function: Callable[[], Any]) -> Future[Any]:
        self._last = super().submit(function)
        self._last.add_done_callback(self._hang.notify)
        return self._last

    def wait(self, future: Future[Any], timeout_s: float) -> bool:
        self._hang.wait_for(future.done)
        return future.done()

    def end(self, wait_s: float = 0.0) -> None:
        self.ended = True
        super().end()
        while wait_s and self.alive and not self._hang.on:
            super().end(0.001)

    def settle(self) -> None:
        """Let it come to the end of all calls that were submitted, or hang in one."""
        if self._last is not None:
            self._hang.wait_for(self._last.done)

    def wait_for_end(self) -> None:
        """Wait until it is gone; nothing must hang any more."""
        super().end(PATIENCE_S)
        assert not self.alive
