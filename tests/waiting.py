"""Waiting for what says nothing when it happens: the end of a process, a file, a row."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""Far longer than anything takes on a busy machine: only a failure takes so long."""
LOOK_EVERY_S = 0.01


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Look again and again until the condition holds; AssertionError if it never does."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up_s, f"waited in vain for {what}"
        time.sleep(LOOK_EVERY_S)
