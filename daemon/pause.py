"""The switch between the slot loop and whoever else needs the cameras for a while."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Pause:
    """One holder at a time keeps slots from being taken; the cameras are released meanwhile."""

    def __init__(
        self,
        release_cameras: Callable[[], None],
        changed: Callable[[str | None], None] = lambda _reason: None,
    ) -> None:
        """`changed` hears the reason when a pause begins, and None when it ends."""
        self._release_cameras = release_cameras
        self._changed = changed
        self._slot = threading.Lock()
        """Held while a slot uses the cameras, and while the switch is thrown."""
        self._holder: object | None = None
        self._reason: str | None = None

    @property
    def reason(self) -> str | None:
        """Why slots are not taken; None while they are."""
        return self._reason

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
    def slot(self) -> Iterator[str | None]:
        """Keep the cameras for a slot; gives the reason why it must not use them, or None."""
        with self._slot:
            yield self._reason
