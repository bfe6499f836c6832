"""SQLite's write-ahead log, read without SQLite: which frames are whole, and which were committed.

SQLite silently drops every frame after the first one that is not whole. That is right after a cut
in the middle of a commit, and loses acknowledged rows when a frame in the middle was damaged. The
format is that of https://sqlite.org/fileformat2.html#walformat.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_HEADER = struct.Struct(">8I")
_FRAME = struct.Struct(">6I")
_MAGIC = 0x377F0682
"""The lowest bit says in which byte order checksums are reckoned."""
_MASK = 0xFFFFFFFF
PAGE_SIZES = frozenset(512 << power for power in range(8))


@dataclass(frozen=True, slots=True)
class Frame:
    """One page as a transaction left it."""

    page: int
    """Its number in the database, from 1."""
    commits: bool
    """The last frame of its transaction."""
    whole: bool
    """Its checksum fits it and the frame before."""
    data: bytes


def read_log(path: Path) -> list[Frame]:
    """The frames since the log was last begun anew, damaged ones among them, in order.

    A log that is missing, empty or of which not even the beginning can be read has none.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return []
    return list(_frames(content))


def lost_commits(frames: list[Frame]) -> int:
    """How many commits are known to lie behind a damaged frame: SQLite would drop them.

    One alone may be what a cut left of a commit that never ended: nobody was told of it. A second
    was begun only after the first was safe.
    """
    damaged = next((index for index, frame in enumerate(frames) if not frame.whole), len(frames))
    return sum(frame.commits and frame.whole for frame in frames[damaged:])


def committed(frames: list[Frame]) -> list[Frame]:
    """The frames up to the last commit that is whole."""
    ends = [index + 1 for index, frame in enumerate(frames) if frame.commits and frame.whole]
    return frames[: ends[-1]] if ends else []


def _frames(content: bytes) -> Iterator[Frame]:
    if len(content) < _HEADER.size + _FRAME.size:
        return
    magic, _, page_size, _, *salts, first, second = _HEADER.unpack_from(content)
    if magic & ~1 != _MAGIC or page_size not in PAGE_SIZES:
        return
    order = ">" if magic & 1 else "<"
    chain = (first, second)
    for start in range(_HEADER.size, len(content) - page_size - _FRAME.size + 1, page_size + 24):
        page, size_after, salt_1, salt_2, *stored = _FRAME.unpack_from(content, start)
        if [salt_1, salt_2] != salts:
            return  # left from before the log was begun anew
        data = content[start + _FRAME.size : start + _FRAME.size + page_size]
        reckoned = _checksum(content[start : start + 8] + data, chain, order)
        chain = (stored[0], stored[1])
        yield Frame(page, commits=size_after > 0, whole=reckoned == chain, data=data)


def _checksum(data: bytes, chain: tuple[int, int], order: str) -> tuple[int, int]:
    first, second = chain
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for index in range(0, len(words), 2):
        first = (first + words[index] + second) & _MASK
        second = (second + words[index + 1] + first) & _MASK
    return first, second
