"""Every frame that a row names: there, and what was stored; and every stored pair has its row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

from daemon.store.frames.archive import FrameArchive
from daemon.store.frames.table import pairs, sha256
from daemon.store.sqlite import any_text, connect_readonly, said_plainly
from daemon.store.verification import Counted, Finding
from daemon.times import slot_text
from drivers.errors import FrameSetError
from drivers.frameset import read_frame_set

DAY = timedelta(days=1)
RESTORE = "restore it from a copy; its value stays, but cannot be measured again"

Removed = Callable[[datetime], bool]
"""Whether a slot's frames were removed on purpose."""
Named = Mapping[datetime, tuple[str | None, str | None]]
"""The frames that each slot's row names, relative to the state directory."""


@dataclass(frozen=True, slots=True)
class ArchiveCheck:
    """One look at the frame archive of a state directory."""

    database: Path
    removed: Removed
    until_utc: datetime
    """The last slot accounted for when the look began: later ones may be half done."""
    counted: Counted

    def findings(
        self, since_utc: datetime | None, tell: Callable[[int, int], None]
    ) -> Iterator[Finding]:
        """Look at day after day. Raises StoreError."""
        days = self._days(since_utc)
        for index, day in enumerate(days):
            tell(index, len(days))
            try:
                yield from self._day(day)
            except OSError as error:
                text = f"cannot be read ({error.strerror})"
                yield Finding("frame", str(error.filename or day), text, "look at the disk")

    def _days(self, since_utc: datetime | None) -> list[date]:
        """Days with rows that name frames, or with frames."""
        with said_plainly(self.database), closing(connect_readonly(self.database)) as connection:
            connection.text_factory = any_text
            query = (
                "SELECT DISTINCT substr(slot_utc, 1, 10) FROM measurement"
                " WHERE main_frame IS NOT NULL AND slot_utc >= ?"
            )
            found = connection.execute(query, (slot_text(since_utc) if since_utc else "",))
            days = {day for (text,) in found if (day := _day_of(text))}
        archive = FrameArchive(self.database.parent)
        for directory in archive.directory.glob("[0-9][0-9][0-9][0-9]/[01][0-9]/[0-3][0-9]"):
            day = date(*(int(part) for part in directory.parts[-3:]))
            if since_utc is None or day >= since_utc.date():
                days.add(day)
        return sorted(days)

    def _day(self, day: date) -> Iterator[Finding]:
        begin = datetime(day.year, day.month, day.day, tzinfo=UTC)
        directory = FrameArchive(self.database.parent).directory / f"{day:%Y/%m/%d}"
        there = {path.name for path in directory.iterdir()} if directory.is_dir() else set()
        stored = {slot for slot, _ in pairs(directory)} if there else set()
        known = self._rows(begin)
        yield from self._missing(known)
        for slot_utc in sorted(stored - known.keys()):
            if slot_utc <= self.until_utc:
                todo = "restart dcamd: it measures pairs of the last 7 days"
                text = f"slot {slot_text(slot_utc)} has frames and no row"
                yield Finding("frame", str(directory), text, todo)
        yield from self._damaged(directory, there)

    def _missing(self, known: Named) -> Iterator[Finding]:
        for slot_utc, names in known.items():
            lost = [n for n in names if n and not (self.database.parent / n).exists()]
            if lost and self.removed(slot_utc):
                self.counted.slots_with_frames_removed += 1
                continue
            for name in lost:
                text = f"the row of slot {slot_text(slot_utc)} names it, it is not there"
                yield Finding("frame", name, text, RESTORE)

    def _damaged(self, directory: Path, there: set[str]) -> Iterator[Finding]:
        """Check the images against the checksums that were entered when they were stored."""
        if not any(name.endswith(".png") for name in there):
            return
        try:
            lines = read_frame_set(directory).rows
        except FrameSetError as error:
            yield Finding("table", str(directory), str(error), "restart dcamd: it writes it again")
            return
        for line in lines:
            for name, expected in (
                (line.main, line.extra.get("sha256_main")),
                (line.sub, line.extra.get("sha256_sub")),
            ):
                if name not in there or not expected:
                    continue
                self.counted.images += 1
                try:
                    sound = sha256((directory / name).read_bytes()) == expected
                except FileNotFoundError:  # removed on purpose this moment
                    continue
                if not sound:
                    text = "not the image that was stored (sha256 differs)"
                    yield Finding("frame", str(directory / name), text, RESTORE)

    def _rows(self, begin: datetime) -> Named:
        """A day's rows with their frames."""
        limits = (slot_text(begin), slot_text(begin + DAY))
        with said_plainly(self.database), closing(connect_readonly(self.database)) as connection:
            connection.text_factory = any_text
            rows = connection.execute(
                "SELECT slot_utc, main_frame, sub_frame FROM measurement"
                " WHERE slot_utc >= ? AND slot_utc < ?",
                limits,
            ).fetchall()
        return {slot: (main, sub) for text, main, sub in rows if (slot := _slot_of(text))}


def _day_of(text: str) -> date | None:
    """A day; None of a damaged row, which is reported as such."""
    try:
        return date.fromisoformat(text)
    except ValueError:
        return None


def _slot_of(text: str) -> datetime | None:
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        return None
