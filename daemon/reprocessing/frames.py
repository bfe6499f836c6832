"""Slots whose frames can be measured again: of frame sets, here or at a URL, or those kept."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol

from core.moment import Moment
from core.results import Measurement
from core.site import Site
from daemon.remote_path import RemotePath, is_url
from daemon.slots.measuring import (
    ActiveCalibration,
    ImagePair,
    PairFiles,
    SlotPair,
    first_moment,
    judge,
    load_pairs,
    read_pair,
    row_moment,
    see,
)
from daemon.store.frames.archive import FOLDER, FrameArchive, translated
from daemon.store.frames.table import pairs
from drivers.errors import FrameSetError
from drivers.frameset import TABLE, FramePath, FrameSetRow, read_table, slots_of_rows

_DAY = timedelta(days=1)
_DAYS = "[0-9][0-9][0-9][0-9]/[01][0-9]/[0-3][0-9]"
"""Of an archive's directories, each a frame set."""


@dataclass(frozen=True, slots=True)
class SeenSlot:
    """What the frames of a slot show, whatever the rows before."""

    slot_utc: datetime
    moment: Moment
    pairs: tuple[SlotPair, ...]


class SlotFrames(Protocol):
    """The frames of one slot, where they lie."""

    @property
    def slot_utc(self) -> datetime:
        """The slot."""

    @property
    def moment(self) -> Moment | None:
        """When it was, and how warm the rig was; None: as stands beside the images."""

    def images(self, site: Site) -> Iterable[ImagePair]:
        """Read its pairs, one by one."""

    def files(self) -> Iterable[FramePath]:
        """Where its images are, or would be."""


@dataclass(frozen=True, slots=True)
class SetSlot:
    """A slot of a frame set."""

    slot_utc: datetime
    pairs: tuple[PairFiles, ...]

    @property
    def moment(self) -> Moment | None:
        """As the set's table says."""
        return self.pairs[0].moment

    def images(self, site: Site) -> Iterable[ImagePair]:
        """Read its pairs; one that is missing or damaged is a reason. Raises StorageError."""
        return (read_pair(pair, site) for pair in self.pairs)

    def files(self) -> Iterable[FramePath]:
        """Those that the table names."""
        return [path for pair in self.pairs for path in (pair.main, pair.sub) if path is not None]


@dataclass(frozen=True, slots=True)
class KeptSlot:
    """A slot of the archive, its images checked against their checksums."""

    state: Path
    slot_utc: datetime

    @property
    def moment(self) -> Moment | None:
        """Stands beside the images."""
        return None

    def images(self, site: Site) -> Iterable[ImagePair]:  # noqa: ARG002 - as SlotFrames
        """Read its pairs. Raises ArchiveError."""
        return load_pairs(FrameArchive(self.state), self.slot_utc)[0]

    def files(self) -> Iterable[FramePath]:
        """Those of its first pair."""
        stored = FrameArchive(self.state).place(self.slot_utc, 1)
        return [self.state / stored.main_path, self.state / stored.sub_path]


def see_slot(frames: SlotFrames, site: Site, calibration: ActiveCalibration) -> SeenSlot:
    """Read a slot's images and find what they show. Raises ArchiveError, StorageError."""
    seen = tuple(see(pair, site, calibration) for pair in frames.images(site))
    moment = frames.moment or first_moment(seen) or Moment(frames.slot_utc.timestamp())
    return SeenSlot(frames.slot_utc, moment, seen)


def measure_alone(frames: SlotFrames, site: Site, calibration: ActiveCalibration) -> Measurement:
    """Measure a slot without the rows before it. Raises ArchiveError, StorageError."""
    return judge(see_slot(frames, site, calibration).pairs, site, calibration)


class Frames(Protocol):
    """Many slots, in order."""

    def slots(self) -> Iterator[SlotFrames]:
        """Give them; no more than a day's are in memory. Raises FrameSetError, ArchiveError."""

    def counted(self) -> tuple[int, bool]:
        """How many slots, and whether any has several pairs. Raises as `slots`."""


@dataclass(frozen=True, slots=True)
class KeptFrames:
    """The slots of the archive with since <= slot < until."""

    state: Path
    since: datetime
    until: datetime

    def slots(self) -> Iterator[KeptSlot]:
        """Give them in order. Raises ArchiveError."""
        last: datetime | None = None
        for slot_utc, _ in self._pairs():
            if slot_utc != last:
                yield KeptSlot(self.state, slot_utc)
            last = slot_utc

    def counted(self) -> tuple[int, bool]:
        """As `Frames`."""
        total, last, bursts = 0, None, False
        for slot_utc, number in self._pairs():
            total += slot_utc != last
            bursts |= number > 1
            last = slot_utc
        return total, bursts

    def _pairs(self) -> Iterator[tuple[datetime, int]]:
        archive = FrameArchive(self.state)
        for day in archive.days():
            begins_utc = datetime(day.year, day.month, day.day, tzinfo=UTC)
            if begins_utc >= self.until or begins_utc + _DAY <= self.since:
                continue
            directory = archive.day_directory(day)
            with translated(directory):
                stored = list(pairs(directory))
            yield from (pair for pair in stored if self.since <= pair[0] < self.until)


@dataclass(frozen=True, slots=True)
class SetFrames:
    """The `measure` rows of frame sets that follow one another."""

    directories: tuple[FramePath, ...]

    def slots(self) -> Iterator[SetSlot]:
        """Give them in order. Raises FrameSetError, StorageError."""
        last_utc: datetime | None = None
        for directory in self.directories:
            for rows in slots_of_rows(_measured(directory)):
                slot_utc = rows[0].slot_utc
                if last_utc is not None and slot_utc <= last_utc:
                    msg = f"{directory / TABLE}: begins before the set before it ends; put it right"
                    raise FrameSetError(msg)
                last_utc = slot_utc
                yield SetSlot(slot_utc, tuple(_files(directory, row) for row in rows))

    def counted(self) -> tuple[int, bool]:
        """As `Frames`."""
        sizes = [len(slot.pairs) for slot in self.slots()]
        return len(sizes), any(size > 1 for size in sizes)


def frames_at(place: str) -> SetFrames:
    """The frame set at a directory or URL, or the archive of such: a directory a day.

    Raises FrameSetError, StorageError, UsageError.
    """
    root = RemotePath(place) if is_url(place) else Path(place).absolute()
    if not is_url(place) and not Path(place).is_dir():
        msg = f"{place}: no such directory; give the directory of a frame set"
        raise FrameSetError(msg)
    if next(iter(root.glob(TABLE)), None) is None:
        for pattern in (_DAYS, f"{FOLDER}/{_DAYS}"):
            tables: list[Path | RemotePath] = sorted(root.glob(f"{pattern}/{TABLE}"), key=str)
            if tables:
                return SetFrames(tuple(_parent(table) for table in tables))
    return SetFrames((root,))


def _parent(table: Path | RemotePath) -> FramePath:
    if isinstance(table, RemotePath):
        return RemotePath(table.url.rpartition("/")[0])
    return table.parent


def _measured(directory: FramePath) -> list[FrameSetRow]:
    return [row for row in read_table(directory) if row.role == "measure"]


def _files(directory: FramePath, row: FrameSetRow) -> PairFiles:
    main, sub = (directory / name if name else None for name in (row.main, row.sub))
    return PairFiles(main, sub, row_moment(row), _skew_s(row))


def _skew_s(row: FrameSetRow) -> float | None:
    """The skew that the frame archive keeps in its tables; other sets have none."""
    try:
        return float(row.extra.get("skew_s", ""))
    except ValueError:
        return None
