"""Ending a session early: the head is halted, and the user reads what happens to the views."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from daemon.errors import WorkFailedError


@contextmanager
def explained_when_interrupted(consequence: str) -> Iterator[None]:
    """Say what happens to the views when Ctrl-C or SIGTERM ends the block."""
    try:
        yield
    except KeyboardInterrupt:
        msg = f"interrupted; {consequence}"
        raise WorkFailedError(msg) from None


@contextmanager
def stopping_cleanly() -> Iterator[None]:
    """Let SIGTERM and a closed terminal end the block as Ctrl-C does: the head is halted."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = {
        number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
