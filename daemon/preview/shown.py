"""The latest look at both cameras, for those who show it."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # it loads OpenCV and the numerics, which the page does without
    from daemon.preview.snapshot import Snapshot


class Shown:
    """From the thread that takes pairs to those that answer a browser."""

    def __init__(self, site: str) -> None:
        self.site = site
        self._lock = threading.Lock()
        self._look: Snapshot | None = None
        self._trouble = "waiting for the first pair"

    def show(self, look: Snapshot) -> None:
        """A pair was taken."""
        with self._lock:
            self._look, self._trouble = look, ""

    def tell(self, trouble: str) -> None:
        """No pair could be taken."""
        with self._lock:
            self._trouble = trouble

    def now(self) -> tuple[Snapshot | None, str]:
        """The latest look, and what is wrong since."""
        with self._lock:
            return self._look, self._trouble
