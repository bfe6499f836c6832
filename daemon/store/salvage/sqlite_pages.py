"""Rows out of the pages of a database file, without SQLite: what a damaged one still holds.

Every page is looked at for itself, whatever the pages above it say of it: a damaged page costs its
own rows only. What a row is worth is for its checksum to say. The format is that of
https://sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from daemon.store.salvage.sqlite_wal import PAGE_SIZES, Log, read_log

Value = int | float | str | bytes | None

_TABLE_LEAF = 0x0D
_LARGEST_ROW = 64 << 20
"""A damaged size must not send the reader round a chain for ever."""
_LEAF_HEADER = 8
_USUAL_PAGE_SIZE = 4096
_INT_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}


@dataclass(frozen=True, slots=True)
class RawRow:
    """A row as it lies in a page; of which table is not known."""

    rowid: int
    values: tuple[Value, ...]
    guessed: bool
    """The page does not say that it holds rows: a byte of its own may be damaged."""


class PageFile:
    """The pages of a database file under those of its log; closed by `close`."""

    def __init__(self, path: Path, *, with_log: bool = True) -> None:
        self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self.size_bytes = os.fstat(self._file).st_size
        self.page_size = self._page_size()
        log = path.with_name(path.name + "-wal")
        self.log = read_log(log, self.page_size) if with_log else Log()
        frames = self.log.committed
        if frames:
            self.page_size = len(frames[0].data)
        self._newest = self.log.newest_pages
        self._older = [frame for frame in frames if frame.data is not self._newest.get(frame.page)]
        self.unreadable = 0
        """Pages that the disk would not give."""

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    @property
    def count(self) -> int:
        """Pages in file and log."""
        return max([self.size_bytes // self.page_size, *self._newest])

    def holds_newest_of_log(self) -> bool:
        """Whether the file has all that the log has committed: nothing is lost with the log."""
        return all(self._from_file(number) == page for number, page in self._newest.items())

    def log_rows(self) -> Iterator[RawRow]:
        """The rows of the log's newest pages alone."""
        for number, page in self._newest.items():
            if number != 1:
                yield from leaf_rows(page, self._page)

    def rows(
        self, tell: Callable[[int, int], None] = lambda _d, _t: None, last: int | None = None
    ) -> Iterator[RawRow]:
        """The rows of the newest whole version of every page; of page 1 none, it is SQLite's."""
        total = min(last or self.count, self.count)
        for number in range(2, total + 1):
            if number % 1000 == 0:
                tell(number, total)
            yield from leaf_rows(self._page(number), self._page)

    def older_rows(self) -> Iterator[RawRow]:
        """The rows of damaged and of superseded versions: for what the newest does not give."""
        for frame in self._older:
            if frame.page != 1:
                yield from leaf_rows(frame.data, self._page)
        for number in self._newest:
            if number != 1:
                yield from leaf_rows(self._from_file(number), self._page)

    def _page(self, number: int) -> bytes:
        return self._newest.get(number) or self._from_file(number)

    def _from_file(self, number: int) -> bytes:
        if number < 1:
            return b""
        try:
            return os.pread(self._file, self.page_size, (number - 1) * self.page_size)
        except OSError:
            self.unreadable += 1
            return b""

    def _page_size(self) -> int:
        try:
            size = int.from_bytes(os.pread(self._file, 2, 16), "big")
        except OSError:
            size = 0
        size = 65536 if size == 1 else size
        return size if size in PAGE_SIZES else _USUAL_PAGE_SIZE


def leaf_rows(page: bytes, read_page: Callable[[int], bytes]) -> Iterator[RawRow]:
    """The rows of a page, taken for a table's leaf; those that make no sense are left out."""
    places = (len(page) - _LEAF_HEADER) // 2
    if places < 1:
        return
    (count,) = struct.unpack_from(">H", page, 3)
    for index in range(min(count, places)):
        (start,) = struct.unpack_from(">H", page, _LEAF_HEADER + 2 * index)
        if start < _LEAF_HEADER:
            continue
        try:
            size, at = _varint(page, start)
            rowid, at = _varint(page, at)
            values = _values(_payload(page, at, size, read_page))
        except (IndexError, ValueError, struct.error):
            continue
        yield RawRow(_signed(rowid), values, guessed=page[0] != _TABLE_LEAF)


def _payload(page: bytes, at: int, size: int, read_page: Callable[[int], bytes]) -> bytes:
    """A row's record: what does not fit into its leaf goes on in a chain of overflow pages."""
    if size > _LARGEST_ROW:
        msg = "no row is that long"
        raise ValueError(msg)
    usable = len(page)
    here = size
    if size > usable - 35:
        least = (usable - 12) * 32 // 255 - 23
        here = least + (size - least) % (usable - 4)
        here = here if here <= usable - 35 else least
    parts, missing = [page[at : at + here]], size - here
    following = at + here
    source = page
    while missing > 0:
        (number,) = struct.unpack_from(">I", source, following)
        source, following = read_page(number), 0
        part = source[4 : 4 + missing]
        if not part:
            msg = "the chain breaks off"
            raise ValueError(msg)
        parts.append(part)
        missing -= len(part)
    record = b"".join(parts)
    if len(record) != size:
        msg = "the record leaves its page"
        raise ValueError(msg)
    return record


def _values(record: bytes) -> tuple[Value, ...]:
    header_size, at = _varint(record, 0)
    kinds = []
    while at < header_size:
        kind, at = _varint(record, at)
        kinds.append(kind)
    values = []
    for kind in kinds:
        value, at = _value(record, at, kind)
        values.append(value)
    if at != len(record):
        msg = "the record is longer or shorter than its header says"
        raise ValueError(msg)
    return tuple(values)


def _value(record: bytes, at: int, kind: int) -> tuple[Value, int]:
    if kind == 0:
        return None, at
    if kind in _INT_BYTES:
        end = at + _INT_BYTES[kind]
        return int.from_bytes(record[at:end], "big", signed=True), end
    if kind == 7:
        return float(struct.unpack_from(">d", record, at)[0]), at + 8
    if kind in {8, 9}:
        return kind - 8, at
    if kind in {10, 11}:
        msg = "no such kind of value"
        raise ValueError(msg)
    end = at + (kind - 12) // 2
    content = record[at:end]
    return (content.decode() if kind % 2 else content), end


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of 1 to 9 bytes, and where it ends."""
    value = 0
    for index in range(8):
        byte = data[at + index]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + index + 1
    return value << 8 | data[at + 8], at + 9


def _signed(value: int) -> int:
    return value - (1 << 64) if value >> 63 else value
