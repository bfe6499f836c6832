"""Calls into a library that may block, each with a deadline."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, TypeVar

_T = TypeVar("_T")


class DeadlineExceededError(Exception):
    """A call did not return in time; its thread must not be used any more."""


class DeadlineThread:
    """One thread that makes calls in order, while the caller waits no longer than it wants.

    A call that never returns cannot be stopped, only left behind: the caller drops this object,
    the thread runs `at_end` when the library lets it go, and ends. All objects of the library are
    then made, used and released in the same thread.
    """

    def __init__(self, name: str, at_end: Callable[[], None]) -> None:
        self._calls: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = (
            queue.SimpleQueue()
        )
        self._at_end = at_end
        # A daemon, so that a library that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread still runs, perhaps left behind in a call."""
        return self._thread.is_alive()

    def call(self, function: Callable[[], _T], timeout_s: float) -> _T:
        """Give what `function` returns or raises; DeadlineExceededError after `timeout_s`."""
        future = self.submit(function)
        try:
            return future.result(timeout_s)
        except TimeoutError:
            if future.done():  # a TimeoutError of the function's own
                raise
            future.cancel()
            raise DeadlineExceededError from None

    def submit(self, function: Callable[[], _T]) -> Future[_T]:
        """Make a call without waiting for it; cancelled in time, it is not made."""
        future: Future[_T] = Future()
        self._calls.put((function, future))
        return future

    def wait(self, future: Future[Any], timeout_s: float) -> bool:
        """Wait for the end of a submitted call, no longer than asked; whether it has ended."""
        wait([future], timeout_s)
        return future.done()

    def end(self, wait_s: float = 0.0) -> None:
        """Let the thread release what it holds and end; wait for that no longer than given."""
        self._calls.put(None)
        self._thread.join(wait_s)

    def _run(self) -> None:
        while (item := self._calls.get()) is not None:
            _make_call(*item)
            del item  # it holds the function's objects until the next call comes
        self._at_end()


def _make_call(function: Callable[[], _T], future: Future[_T]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(function())
    except BaseException as error:  # noqa: BLE001  (whatever it is, it belongs to the caller)
        # The traceback holds the library's objects, which must be released in this thread.
        error.__traceback__ = error.__context__ = error.__cause__ = None
        future.set_exception(error)
