"""Extremes, means and counts of the record over spans of time, in files of the page's own.

A level has buckets of one width. A bucket's place in its file follows from its time, so that what
changes is written in place, and what is asked for is one read. Times without rows are holes that
take no room. Everything here can be deleted: it is made again from the record.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from core.arrays import FloatArray
from daemon.store.queries.chart_rows import ChartRows, Masks, Times

EPOCH_S = 946_684_800
"""2000-01-01: nothing before it is kept."""
DAY_S = 86_400
FACTOR = 8
LEVELS = 5
ROWS_A_BUCKET = 8
"""Of the lowest level, with rows as the schedule has them."""

BUCKET = np.dtype([("min", "<f4"), ("max", "<f4"), ("mean", "<f4"), ("count", "<u4")])
MASK = np.dtype("<u8")
DAY = np.dtype([("rows", "<u4"), ("good", "<u4"), ("value", "<u4"), ("worst", "<u4"),
                ("digest", "<u8"), ("frame_s", "<u8")])  # fmt: skip
FLAGS = "flags"
DAYS = "days"

Buckets = npt.NDArray[np.void]


def lowest_width_s(period_s: int) -> int:
    """The width of the lowest level: a part of a day, so that no bucket lies in two."""
    most = min(ROWS_A_BUCKET * period_s, DAY_S)
    return next(width for width in range(most, 0, -1) if DAY_S % width == 0)


@dataclass(frozen=True, slots=True)
class Pyramid:
    """The files below a directory."""

    directory: Path
    lowest_s: int

    def width_s(self, level: int) -> int:
        """The width of a level's buckets."""
        return self.lowest_s * int(FACTOR**level)

    def quantities(self) -> set[str]:
        """What there is."""
        found = (self.directory / "0").glob("*.bin")
        return {path.stem for path in found} - {FLAGS}

    def clear(self) -> None:
        """Forget everything."""
        shutil.rmtree(self.directory, ignore_errors=True)

    def read(self, level: int, quantity: str, first: int, count: int) -> Buckets:
        """`count` buckets of a level from number `first` on; those without values count 0."""
        return self._read(self._file(level, quantity), BUCKET, first, count)

    def read_masks(self, level: int, first: int, count: int) -> Masks:
        """What the rows of each bucket say of themselves, joined."""
        return self._read(self._file(level, FLAGS), MASK, first, count)

    def read_days(self, first: int, count: int) -> Buckets:
        """What is known of days, from number `first` since 2000 on."""
        return self._read(self.directory / f"{DAYS}.bin", DAY, first, count)

    def write_day(self, day: int, rows: ChartRows, frame_s: int) -> None:
        """Put a day's rows in the place of what was known of it; all levels follow."""
        count = DAY_S // self.lowest_s
        first = day * count
        start_s = EPOCH_S + day * DAY_S
        place = (rows.time_s - start_s) // self.lowest_s
        for quantity in self.quantities() | set(rows.values):
            values = rows.values.get(quantity)
            buckets = np.zeros(count, BUCKET) if values is None else _joined(place, values, count)
            self._write(self._file(0, quantity), first, buckets)
            self._raise(quantity, first, count)
        masks = np.zeros(count, MASK)
        np.bitwise_or.at(masks, place, rows.masks)
        self._write(self._file(0, FLAGS), first, masks)
        self._raise_masks(first, count)
        self._write(self.directory / f"{DAYS}.bin", day, _day(rows, frame_s))

    def _raise(self, quantity: str, first: int, count: int) -> None:
        """Work the levels above out again, where some buckets of the lowest have changed."""
        for level in range(1, LEVELS):
            first, last = first // FACTOR, (first + count - 1) // FACTOR
            count = last - first + 1
            below = self.read(level - 1, quantity, first * FACTOR, count * FACTOR)
            self._write(self._file(level, quantity), first, merged(below, FACTOR))

    def _raise_masks(self, first: int, count: int) -> None:
        for level in range(1, LEVELS):
            first, last = first // FACTOR, (first + count - 1) // FACTOR
            count = last - first + 1
            below = self.read_masks(level - 1, first * FACTOR, count * FACTOR)
            joined = np.bitwise_or.reduce(below.reshape(-1, FACTOR), axis=1)
            self._write(self._file(level, FLAGS), first, joined)

    def _file(self, level: int, name: str) -> Path:
        return self.directory / str(level) / f"{name}.bin"

    def _read(self, path: Path, kind: np.dtype[Any], first: int, count: int) -> npt.NDArray[Any]:
        found = np.zeros(count, kind)
        skipped = max(-first, 0)
        if skipped >= count:
            return found
        try:
            with _opened(path, os.O_RDONLY) as file:
                size, start = (count - skipped) * kind.itemsize, (first + skipped) * kind.itemsize
                data = os.pread(file, size, start)
        except FileNotFoundError:
            return found
        there = np.frombuffer(data, kind, len(data) // kind.itemsize)
        found[skipped : skipped + len(there)] = there
        return found

    def _write(self, path: Path, first: int, content: npt.NDArray[Any]) -> None:
        data, start = content.tobytes(), first * content.dtype.itemsize
        with _opened(path, os.O_RDWR | os.O_CREAT) as file:
            if any(data) or start < os.fstat(file).st_size:
                os.pwrite(file, data, start)


@contextmanager
def _opened(path: Path, how: int) -> Iterator[int]:
    if how & os.O_CREAT:
        path.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(path, how | os.O_CLOEXEC, 0o640)
    try:
        yield file
    finally:
        os.close(file)


def _joined(place: Times, values: FloatArray, count: int) -> Buckets:
    """Values by their buckets' numbers; what is NaN is not counted."""
    there = np.isfinite(values)
    return bucketed(place[there], values[there], count)


def bucketed(place: Times, values: FloatArray, count: int) -> Buckets:
    """Finite values, in order of their buckets' numbers, as `count` buckets."""
    buckets = np.zeros(count, BUCKET)
    if not len(values):
        return buckets
    starts = np.flatnonzero(np.diff(place, prepend=-1))
    at = place[starts]
    numbers = np.diff(starts, append=len(values))
    buckets["min"][at] = np.minimum.reduceat(values, starts)
    buckets["max"][at] = np.maximum.reduceat(values, starts)
    buckets["mean"][at] = np.add.reduceat(values, starts) / numbers
    buckets["count"][at] = numbers
    return buckets


def merged(buckets: Buckets, factor: int) -> Buckets:
    """Each `factor` buckets as one."""
    if factor == 1:
        return buckets
    groups = buckets.reshape(-1, factor)
    counts = groups["count"].astype(np.float64)
    total = counts.sum(axis=1)
    found = np.zeros(len(groups), BUCKET)
    there = groups["count"] > 0
    some = total > 0
    found["min"] = np.where(some, np.where(there, groups["min"], np.inf).min(axis=1), 0.0)
    found["max"] = np.where(some, np.where(there, groups["max"], -np.inf).max(axis=1), 0.0)
    found["mean"] = (groups["mean"] * counts).sum(axis=1) / np.maximum(total, 1.0)
    found["count"] = total
    return found


def _day(rows: ChartRows, frame_s: int) -> Buckets:
    flags = rows.flags
    found = np.zeros(1, DAY)
    found["rows"] = len(flags)
    found["good"] = int((flags == 1).sum())
    found["value"] = int((flags <= 3).sum())
    found["worst"] = int(flags.max(initial=0))
    found["digest"] = digest_of(rows.digest)
    found["frame_s"] = frame_s
    return found


def digest_of(total: int) -> int:
    """A sum of digests as a day keeps it."""
    return total % (1 << 63)
