"""A file that only holds space: given up when the disk is full, so that rows can still be written.

A row takes about half a kilobyte, so that 64 MB last for months at one a minute.
"""

from __future__ import annotations

import os
from pathlib import Path

from daemon.durable import fsync_directory

NAME = "dcam.reserve"


class Reserve:
    """The reserve of a state directory; of size 0 there is none."""

    def __init__(self, state: Path, size_bytes: int) -> None:
        self._path = state / NAME
        self._size = size_bytes

    @property
    def is_whole(self) -> bool:
        """Whether the space is held; true where none is wanted."""
        if not self._size:
            return True
        try:
            found = self._path.stat()
        except OSError:
            return False
        return found.st_size == self._size and found.st_blocks * 512 >= self._size

    def make(self) -> None:
        """Hold the space, on the disk for good. Raises OSError, and leaves nothing then."""
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.ftruncate(descriptor, self._size)
            os.posix_fallocate(descriptor, 0, self._size)
            os.fsync(descriptor)
        except OSError:
            self._path.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)
        fsync_directory(self._path.parent)

    def give_up(self) -> bool:
        """Free the space; whether there was any. Raises OSError."""
        try:
            self._path.unlink()
        except FileNotFoundError:
            return False
        return True
