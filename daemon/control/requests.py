"""What the running daemon is asked from outside: to stop, or to go on with another config."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Generic, TypeVar

import structlog

from daemon.error_report import lines_of
from daemon.errors import WorkFailedError

_log = structlog.get_logger("dcam.daemon")
_T = TypeVar("_T")

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
SIGNALS = (*STOP_SIGNALS, signal.SIGHUP)


class ControlRequests(Generic[_T]):
    """Wakes the slot loop, and knows why; the slot in progress ends first."""

    def __init__(self) -> None:
        self.wake = threading.Event()
        """Set when the slot loop is to return."""
        self._lock = threading.Lock()
        self._stopping = False
        self._next: _T | None = None
        self._prepare: Callable[[], _T] | None = None

    def accept_reloads(self, prepare: Callable[[], _T]) -> None:
        """From now on a reload is what `prepare` gives; what it raises leaves all as it is."""
        self._prepare = prepare

    def stop(self) -> None:
        """End after the slot in progress."""
        with self._lock:
            self._stopping = True
            self.wake.set()

    def reload(self) -> None:
        """Go on with what was prepared, after the slot in progress.

        Raises what `prepare` raises, WorkFailedError where there is nothing to reload yet.
        """
        if self._prepare is None:
            msg = "dcamd is still starting; try again"
            raise WorkFailedError(msg)
        prepared = self._prepare()
        with self._lock:
            self._next = prepared
            self.wake.set()

    def take(self) -> _T | None:
        """Give what to go on with now that the slot loop has returned; None is the end."""
        with self._lock:
            if self._stopping:
                return None
            following, self._next = self._next, None
            self.wake.clear()
            return following


@contextmanager
def given_by_signals(requests: ControlRequests[_T]) -> Iterator[None]:
    """While the block runs, SIGTERM and SIGINT stop, and SIGHUP reloads.

    They are obeyed by a thread of its own: a Python handler runs in between two steps of the
    main thread, and could find the event's lock held by the very thread that it interrupts.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def obey() -> None:
        while received := reader.recv(1):
            number = signal.Signals(received[0])
            if number is signal.SIGHUP:
                _reload(requests)
            elif number in STOP_SIGNALS:
                _log.info("stopping", signal=number.name)
                requests.stop()

    obeying = threading.Thread(target=obey, name="signals", daemon=True)
    obeying.start()
    before_fd = signal.set_wakeup_fd(writer.fileno())
    before = {number: signal.signal(number, _noted) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(before_fd)
        writer.close()
        obeying.join()
        reader.close()


def _noted(_number: int, _frame: FrameType | None) -> None:
    """Do nothing: the interpreter has written the signal's number to the wakeup descriptor."""


def _reload(requests: ControlRequests[_T]) -> None:
    try:
        requests.reload()
    except Exception as error:  # noqa: BLE001 - the config in force stays in force
        _log.error("reload_refused", error="; ".join(lines_of(error)))
