"""The switch between the slot loop and whoever else needs the cameras for a while."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime

_LOOK_S = 1.0
"""How often it is looked whether there is room by now, between the ends of slots."""


class CameraLease:
    """One holder at a time keeps slots from being taken; the cameras are released meanwhile."""

    def __init__(
        self,
        release_cameras: Callable[[], None] = lambda: None,
        changed: Callable[[str | None], None] = lambda _reason: None,
    ) -> None:
        """`changed` hears the reason when a pause begins, and None when it ends."""
        self._release_cameras = release_cameras
        self._changed = changed
        self._slot = threading.Condition(threading.Lock())
        """Held while a slot uses the cameras, and while the switch is thrown."""
        self._holder: object | None = None
        self._reason: str | None = None
        self._ended: datetime | None = None
        """The last slot that was over."""

    @property
    def reason(self) -> str | None:
        """Why slots are not taken; None while they are."""
        return self._reason

    def use(self, release_cameras: Callable[[], None]) -> None:
        """Release other cameras from now on."""
        self._release_cameras = release_cameras

    def held_by(self, holder: object) -> bool:
        """Tell whether this holder has it."""
        return self._holder is holder

    def hold(self, holder: object, reason: str) -> bool:
        """Wait for the slot in progress, release the cameras, and keep further slots away.

        False if another holder has it already.
        """
        with self._slot:
            if self._holder not in (None, holder):
                return False
            if self._holder is None:
                self._release_cameras()
            self._holder, self._reason = holder, reason
            self._changed(reason)
            return True

    def release(self, holder: object) -> None:
        """Let slots be taken again; nothing happens if this holder does not have it."""
        with self._slot:
            if self._holder is holder:
                self._holder = self._reason = None
                self._changed(None)

    @contextmanager
    def slot(self, slot_utc: datetime) -> Iterator[str | None]:
        """Keep the cameras for a slot; gives the reason why it must not use them, or None."""
        with self._slot:
            try:
                yield self._reason
            finally:
                self._ended = slot_utc
                self._slot.notify_all()

    @contextmanager
    def between_slots(
        self, has_room: Callable[[datetime | None], bool], timeout_s: float
    ) -> Iterator[str | None]:
        """Have the cameras between two slots; gives why not, or None.

        Waits until `has_room` of the last slot that was over, for so long at most.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._slot:
            while self._holder is None and not has_room(self._ended):
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0:
                    yield "there was no time for it between two slots"
                    return
                self._slot.wait(min(left_s, _LOOK_S))
            yield None if self._holder is None else f"paused: {self._reason}"
