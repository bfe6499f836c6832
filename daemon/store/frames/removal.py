"""Pairs that are to go: their images first, main before sub, then their lines, then the directory.

In this order nothing needs space on a full disk but the table, which is written when there is
some again. A cut leaves pairs whole, half or gone; what is half is no pair, is never measured, and
goes with the next removal of that day. Lines are struck by what is there, so it may be repeated.
"""

from __future__ import annotations

import contextlib
import errno
import re
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from daemon.durable import fsync_directory
from daemon.store.frames.table import prune
from drivers.frameset import TABLE

_IMAGE = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d)(_\d\d)?_(main|sub)\.png")


@dataclass(frozen=True, slots=True)
class DayFiles:
    """The images in a day's directory, by slot."""

    images: dict[datetime, tuple[str, ...]]
    """Names, in the order in which they are to be removed."""

    @property
    def whole(self) -> set[datetime]:
        """Slots with at least one pair of which both images are there."""
        return {slot for slot, names in self.images.items() if _has_pair(names)}


def files_of_day(directory: Path) -> DayFiles:
    """List a day's images. Raises OSError, also for a day that a link leads out of the archive."""
    archive, parts = directory.parents[2], directory.parts[-3:]
    if directory.resolve() != archive.resolve().joinpath(*parts):
        what = "leads out of the archive: its frames are not touched"
        raise OSError(errno.ELOOP, what, str(directory))
    year, month, day = (int(part) for part in parts)
    found: dict[datetime, list[str]] = defaultdict(list)
    for path in directory.iterdir():
        match = _IMAGE.fullmatch(path.name)
        if match:
            hour, minute, second = (int(part) for part in match.groups()[:3])
            found[datetime(year, month, day, hour, minute, second, tzinfo=UTC)].append(path.name)
    ordered = {slot: tuple(sorted(found[slot], key=_order)) for slot in sorted(found)}
    return DayFiles(ordered)


def bytes_of_day(directory: Path) -> int:
    """What the files of a day take. Raises OSError."""
    total = 0
    for path in directory.iterdir():
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def finish_removal(directory: Path) -> None:
    """Strike the lines of what is gone; a directory that nothing is left in goes too.

    Raises OSError.
    """
    if not directory.is_dir():
        return
    if prune(directory) == 0:
        (directory / TABLE).unlink(missing_ok=True)
        _remove_empty(directory)


def _remove_empty(directory: Path) -> None:
    """Remove a day's directory, its month's and its year's, as far as they are empty."""
    for place in (directory, directory.parent, directory.parent.parent):
        if any(place.iterdir()):
            fsync_directory(place)
            return
        place.rmdir()
    fsync_directory(place.parent)


def _order(name: str) -> tuple[str, str]:
    """By the number within a burst, main before sub."""
    return name[6:].rpartition("_")[0], name


def _has_pair(names: Collection[str]) -> bool:
    return any(
        name.replace("_main", "_sub") in names for name in names if name.endswith("_main.png")
    )
