"""Commands that read for long get out of the way of a running dcamd."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_LOWEST = 19


@contextmanager
def lowest_priority() -> Iterator[None]:
    """Run at the lowest priority; before others go on it is as it was, where that is allowed."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    os.setpriority(os.PRIO_PROCESS, 0, _LOWEST)
    try:
        yield
    finally:
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, before)
