"""SQLite's write-ahead log, read without SQLite: what was written, and what SQLite will read of it.

SQLite silently drops every frame after the first one that is not as written, and the whole log
when its header is not; the next commit then overwrites them. That is right after a cut in the
middle of a commit, and loses acknowledged rows when something in the log was damaged later. Here
every frame that proves itself is found, whatever stands before it. The format is that of
https://sqlite.org/fileformat2.html#walformat.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_HEADER = struct.Struct(">8I")
_FRAME = struct.Struct(">6I")
_MAGIC = 0x377F0682
"""The lowest bit says in which byte order checksums are computed."""
_VERSION = 3007000
"""Of the format, the same since 2010."""
_MASK = 0xFFFFFFFF
_MOST_CHAINS = 4
"""Checksums that a frame behind damaged ones may go on from; one damaged frame leaves two."""
PAGE_SIZES = frozenset(512 << power for power in range(8))

Chain = tuple[int, int]
"""A checksum; that of a frame goes on from that of the frame before."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One page as a transaction left it."""

    page: int
    """Its number in the database, from 1."""
    commits: bool
    """The last frame of its transaction."""
    whole: bool
    """It is what was written: its checksum says so, perhaps after one bit was put right."""
    as_written: bool
    """Whole, with nothing put right: SQLite reads it if it reads all before it."""
    unproven: bool
    """Not whole, and no bit put right makes it so: half written, or damaged in many places."""
    data: bytes


@dataclass(frozen=True, slots=True)
class Log:
    """What was found in a log."""

    frames: tuple[Frame, ...] = ()
    """Since the log was last begun, damaged ones among them, in order."""
    is_header_sound: bool = True
    """If not, SQLite reads nothing of it."""
    has_content: bool = False
    """Whether anything stands behind the header."""

    @property
    def committed(self) -> tuple[Frame, ...]:
        """The frames up to the last commit that is whole."""
        ends = [index + 1 for index, f in enumerate(self.frames) if f.commits and f.whole]
        return self.frames[: ends[-1]] if ends else ()

    @property
    def newest_pages(self) -> dict[int, bytes]:
        """Pages by number, as the last whole commit left them."""
        return {frame.page: frame.data for frame in self.committed if frame.whole}

    @property
    def lost_commits(self) -> int:
        """How many whole commits SQLite would drop.

        What a cut left of a commit that never ended is none of them: nobody was promised it.
        """
        read = 0
        while read < len(self.frames) and self.is_header_sound and self.frames[read].as_written:
            read += 1
        lost = sum(frame.commits and frame.whole for frame in self.frames[read:])
        return lost - 1 if lost and self._is_last_half_written() else lost

    def _is_last_half_written(self) -> bool:
        """Whether the last commit has a frame of which a cut may have kept a part.

        A disk writes the sectors of one commit in any order, those of its last frame perhaps first;
        each commit before was on the disk as a whole before it began.
        """
        *before, _ = self.committed
        begins = max((k + 1 for k, frame in enumerate(before) if frame.commits), default=0)
        return any(frame.unproven for frame in before[begins:])


def read_log(path: Path, database_page_size: int | None = None) -> Log:
    """Read a log; one that is missing, empty or no longer than a part of its header holds nothing.

    The database's page size helps where the log's own header is damaged.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return Log()
    if len(content) < _HEADER.size:
        return Log()
    magic, version, page_size, _, salt_1, salt_2, *stored = _HEADER.unpack_from(content)
    order, salts, chain = "<>"[magic & 1], (salt_1, salt_2), (stored[0], stored[1])
    has_content = len(content) > _HEADER.size
    if (
        magic & ~1 == _MAGIC
        and version == _VERSION
        and page_size in PAGE_SIZES
        and _checksum(content[:24], (0, 0), order) == chain
    ):
        frames = _frames(_raw_frames(content, page_size), salts, (chain,), order)
        return Log(tuple(frames), has_content=has_content)
    # Whatever is wrong with the header, the frames go on from one another.
    sizes = {page_size, database_page_size} & PAGE_SIZES or PAGE_SIZES
    chains = (chain, *(_checksum(content[:24], (0, 0), order) for order in "<>"))
    as_if = ((order, _raw_frames(content, size)) for order, size in product("<>", sizes))
    order, raw = max(as_if, key=lambda one: _links(one[1], chains, one[0]))
    if raw and all(frame.salts != salts for frame in raw):
        salts = raw[0].salts
    frames = _frames(raw, salts, chains, order)
    return Log(tuple(frames), is_header_sound=False, has_content=has_content)


@dataclass(frozen=True, slots=True)
class _RawFrame:
    """A frame as it lies in the file."""

    content: bytes
    """Page number, size of the database, and the page: what the checksum covers."""
    salts: tuple[int, int]
    stored: Chain


def _raw_frames(content: bytes, page_size: int) -> list[_RawFrame]:
    step = _FRAME.size + page_size
    found = []
    for start in range(_HEADER.size, len(content) - step + 1, step):
        *_, salt_1, salt_2, first, second = _FRAME.unpack_from(content, start)
        covered = content[start : start + 8] + content[start + _FRAME.size : start + step]
        found.append(_RawFrame(covered, (salt_1, salt_2), (first, second)))
    return found


def _links(raw: list[_RawFrame], chains: tuple[Chain, ...], order: str) -> int:
    """How many frames go on from the one before them, the first from the header."""
    first = ((frame.content, chain, frame.stored) for frame in raw[:1] for chain in chains)
    rest = ((frame.content, before.stored, frame.stored) for before, frame in pairwise(raw))
    return sum(
        _checksum(content, chain, order) == stored for content, chain, stored in (*first, *rest)
    )


def _frames(
    raw: list[_RawFrame], salts: tuple[int, int], chains: tuple[Chain, ...], order: str
) -> Iterator[Frame]:
    """The frames of this log, by their salts or by their checksums.

    Behind them lies what is left from before the log was last begun. A frame of which one bit has
    changed is given twice, the less likely version first and as not whole: rows that stand in it
    alone prove themselves by checksums of their own.
    """
    last = max((index for index, frame in enumerate(raw) if frame.salts == salts), default=-1)
    for index, frame in enumerate(raw):
        computed = tuple(_checksum(frame.content, chain, order) for chain in chains)
        if frame.stored in computed:
            yield _frame(frame.content, whole=True, as_written=frame.salts == salts)
            chains = (frame.stored,)
            continue
        if index > last:
            return
        versions, proven = _put_right(frame, raw[index + 1 : index + 2], computed, order)
        if not versions:  # of an older log, it ends no commit of this one
            seen = _frame(frame.content)
            commits = seen.commits and frame.salts == salts
            versions = [replace(seen, commits=commits, unproven=True)]
        yield from versions
        chains = (proven,) if proven else (frame.stored, *computed)[:_MOST_CHAINS]


def _put_right(
    frame: _RawFrame, following: list[_RawFrame], computed: tuple[Chain, ...], order: str
) -> tuple[list[Frame], Chain | None]:
    """What a frame may have been before one bit changed, and the checksum that it then had.

    Nothing where that explains nothing.
    """
    for chain in computed:
        content = _with_one_bit_changed(frame.content, chain, frame.stored, order)
        stored_is_wrong = _bits_apart(chain, frame.stored) == 1
        if stored_is_wrong and content is not None and following:  # the next one knows
            (next_,) = following
            stored_is_wrong = _checksum(next_.content, chain, order) == next_.stored
        if stored_is_wrong:
            other = [] if content is None else [_frame(content)]
            return [*other, _frame(frame.content, whole=True)], chain
        if content is not None:
            return [_frame(frame.content), _frame(content, whole=True)], frame.stored
    return [], None


def _frame(content: bytes, *, whole: bool = False, as_written: bool = False) -> Frame:
    page, size_after = struct.unpack_from(">2I", content)
    return Frame(page, size_after > 0, whole, as_written, unproven=False, data=content[8:])


def _checksum(data: bytes, chain: Chain, order: str) -> Chain:
    """Each pair of words w, v adds them: first += second + w, second += first + v."""
    words = np.frombuffer(data, dtype=f"{order}u4").astype(np.uint64)
    words[0] += np.uint64(sum(chain))
    words[1] += np.uint64(chain[1])
    first, second = words @ _weights(len(words))
    return int(first) & _MASK, int(second) & _MASK


def _bits_apart(one: Chain, other: Chain) -> int:
    return sum((a ^ b).bit_count() for a, b in zip(one, other, strict=True))


def _with_one_bit_changed(data: bytes, seen: Chain, stored: Chain, order: str) -> bytes | None:
    """The data with the one bit changed that makes its checksum the stored one, if there is such.

    The checksum is linear modulo 2^32: a change of a word changes it by that word's weights times
    the change. By chance it fits once in 2^48 frames that were damaged otherwise.
    """
    words = np.frombuffer(data, dtype=f"{order}u4").astype(np.uint64)
    weights = _weights(len(words))
    bits = np.uint64(1) << np.arange(32, dtype=np.uint64)
    change = np.where(words[:, None] & bits, -bits & np.uint64(_MASK), bits)
    wanted = [(b - a) & _MASK for a, b in zip(seen, stored, strict=True)]
    fits = np.ones(change.shape, dtype=bool)
    for k in range(2):
        fits &= (weights[:, k, None] * change & np.uint64(_MASK)) == np.uint64(wanted[k])
    places = np.argwhere(fits)
    if len(places) == 0:
        return None
    word, bit = places[0]
    words[word] ^= bits[bit]
    return words.astype(f"{order}u4").tobytes()


@cache
def _weights(words: int) -> NDArray[np.uint64]:
    """By how much each checksum grows when a word grows by one: (words, 2), modulo 2^32."""
    weights = np.empty((words, 2), dtype=np.uint64)
    even, odd = (1, 1), (0, 1)
    for index in range(words - 2, -1, -2):
        weights[index], weights[index + 1] = even, odd
        even, odd = (
            ((first + second) & _MASK, (first + 2 * second) & _MASK)
            for first, second in (even, odd)
        )
    return weights
