"""Giving memory back to the system: the page is small while nobody looks."""

from __future__ import annotations

import ctypes
import mmap
import time
from contextlib import suppress
from pathlib import Path

TEXT_EVERY_S = 60.0
"""Half the program text comes back with the next readers, in some 300 small steps."""

_MAPS = Path("/proc/self/maps")


class Spare:
    """Gives back what the last work has left behind."""

    def __init__(self) -> None:
        self._text_s = -TEXT_EVERY_S

    def give_back(self) -> None:
        """Let the system have freed memory at once, and program text now and then."""
        _trim_heap()
        if time.monotonic() - self._text_s >= TEXT_EVERY_S:
            self._text_s = time.monotonic()
            _unmap_program_text()


def _trim_heap() -> None:
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc's own
        trim(0)


def _unmap_program_text() -> None:
    """Forget the pages of programs and libraries; what is wanted again is mapped again.

    Most of them only the start needed. Text is never written to, so that the file has all of it;
    the kernel keeps it in its cache for as long as nobody wants the room.
    """
    advise = getattr(ctypes.CDLL(None), "madvise", None)
    if advise is None:
        return
    with suppress(OSError):  # a system without /proc
        for line in _MAPS.read_text(encoding="utf-8", errors="replace").splitlines():
            ends, access, _offset, _device, _inode, *name = line.split(maxsplit=5)
            if access == "r-xp" and name and name[0].startswith("/"):
                first, end = (int(place, 16) for place in ends.split("-"))
                advise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), mmap.MADV_DONTNEED)
