"""How the C library keeps memory: what a camera's buffers took goes back to the system."""

from __future__ import annotations

import ctypes

M_MMAP_THRESHOLD = -3
"""Of mallopt, malloc.h of glibc."""
LARGE_BYTES = 128 << 10
"""Where glibc begins."""


def return_large_blocks() -> None:
    """Have each block of 128 kB or more come from the system by itself, and go back when freed.

    glibc raises that limit to the largest block that was freed, up to 32 MB (mallopt(3)). Buffers
    of a camera that is opened again then come from the heap and leave holes there: some 60 kB each
    time. A C library without this option is left as it is.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
