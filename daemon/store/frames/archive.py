"""The frame archive: every pair kept losslessly, on the disk before anyone hears of it.

`frames/YYYY/MM/DD/` below the state directory is itself a frame set: `HHMMSS_main.png`,
`HHMMSS_sub.png` and `frames.csv`; the second pair of a burst is `HHMMSS_02_main.png` and so on.
The order of writes is main, sub, line, pair by pair. A pair whose line a power cut took is still a
pair; the line is written again from the images at the next start.
"""

from __future__ import annotations

import errno
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from types import MappingProxyType

from core.images import GreyImage
from daemon.durable import make_directory_durable, write_durable
from daemon.errors import ArchiveError, DiskFullError, SlotTakenError
from daemon.store.frames.table import (
    EXTRA_COLUMNS,
    append_row,
    find,
    image_names,
    pairs,
    repair,
    sha256,
)
from daemon.store.records import CameraState
from daemon.times import EPOCH, instant_text, slot_text
from drivers.errors import FrameSetError
from drivers.frameset import (
    BURST,
    READING,
    FrameSetRow,
    encode_png,
    optional_number,
    read_image,
    readings_of,
)
from drivers.protocols import CapturedFrame, CapturedPair

FOLDER = "frames"
_NO_READINGS: Mapping[str, float | None] = MappingProxyType({})
LARGEST_BURST = 99
"""Pairs of a slot that file names can tell apart."""


@dataclass(frozen=True, slots=True)
class StoredPair:
    """Where a pair lies: paths relative to the state directory, with forward slashes."""

    slot_utc: datetime
    main_path: str
    sub_path: str


@dataclass(frozen=True, slots=True)
class ArchivedPair:
    """A pair read back, with what is known of it; None where a crash took that knowledge."""

    stored: StoredPair
    main: GreyImage
    sub: GreyImage
    skew_s: float | None
    captured_utc: datetime | None
    main_camera: CameraState
    sub_camera: CameraState
    readings: Mapping[str, float]
    """Of the sensors that gave a value, by name."""


class FrameArchive:
    """The pairs below a state directory. Making one touches nothing on the disk."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.directory = state / FOLDER

    def store(
        self,
        slot_utc: datetime,
        pair: CapturedPair,
        captured_utc: datetime | None = None,
        number: int = 1,
        readings: Mapping[str, float | None] = _NO_READINGS,
    ) -> StoredPair:
        """Write a pair, the `number`th of its slot; it is on the disk, complete, at the return.

        `readings` are those of the slot, by name; None where a sensor gave no value.
        Raises SlotTakenError when the slot has that pair, DiskFullError, ArchiveError.
        """
        stored = self.place(slot_utc, number)
        main, sub = self.state / stored.main_path, self.state / stored.sub_path
        with translated(main.parent):
            taken = main.exists() and sub.exists()
        if taken:
            msg = f"{main}: slot {slot_text(slot_utc)} has a pair already"
            raise SlotTakenError(msg)
        main_data = encode_png(pair.main.pixels, pair.main.bits)
        sub_data = encode_png(pair.sub.pixels, pair.sub.bits)
        known = _extra(pair, captured_utc, sha256(main_data), sha256(sub_data))
        known |= {f"{READING}{name}": _text(value) for name, value in readings.items()}
        known[BURST] = str(number)
        with translated(main.parent):
            make_directory_durable(main.parent)
            write_durable(main, main_data)
            try:
                write_durable(sub, sub_data)
            except OSError:
                _take_back(main)
                raise
            # From here on it is a pair, whatever becomes of its line.
            row = FrameSetRow(slot_utc, "measure", main.name, sub.name, extra=known)
            append_row(main.parent, row)
        return stored

    def load(self, slot_utc: datetime, number: int = 1) -> ArchivedPair:
        """Read a pair back, pixel for pixel.

        Raises FrameSetError when an image is missing, damaged, or not the one that was stored.
        """
        stored = self.place(slot_utc, number)
        main, sub = self.state / stored.main_path, self.state / stored.sub_path
        try:
            known = find(main.parent, slot_utc, number) or {}
            main_image = _verified(main, known.get("sha256_main"))
            sub_image = _verified(sub, known.get("sha256_sub"))
        except OSError as error:
            msg = f"{error.filename or main}: cannot be read ({error.strerror}); check the disk"
            raise FrameSetError(msg) from error
        return ArchivedPair(
            stored=stored,
            main=main_image,
            sub=sub_image,
            skew_s=optional_number(known.get("skew_s")),
            captured_utc=_moment(known.get("captured_utc")),
            main_camera=_camera(known, "main"),
            sub_camera=_camera(known, "sub"),
            readings=readings_of(known),
        )

    def stored_slots(self, since: datetime = EPOCH, last: datetime | None = None) -> list[datetime]:
        """The slots of which both images are there, `since` <= slot <= `last`, in order.

        Raises ArchiveError.
        """
        with translated(self.directory):
            found = (slot for day in self._days(since, last) for slot, _ in pairs(day))
            wanted = (slot for slot in found if slot >= since and (last is None or slot <= last))
            return list(dict.fromkeys(wanted))

    def numbers(self, slot_utc: datetime) -> list[int]:
        """The numbers of a slot's pairs of which both images are there, in order.

        Raises ArchiveError.
        """
        day = (self.state / self.place(slot_utc, 1).main_path).parent
        stem = image_names(slot_utc.astimezone(UTC))[0].removesuffix("main.png")
        with translated(day):
            names = {path.name for path in day.glob(f"{stem}*.png")}
        return [
            number
            for number in range(1, LARGEST_BURST + 1)
            if names.issuperset(image_names(slot_utc.astimezone(UTC), number))
        ]

    def orphans(self, known_slots: Collection[datetime], since: datetime = EPOCH) -> list[datetime]:
        """Stored slots that are not among the known ones: pairs still to be measured, in order."""
        return [slot for slot in self.stored_slots(since) if slot not in known_slots]

    def repair(self, since: datetime = EPOCH) -> list[datetime]:
        """After a crash: bring the tables of the days from `since` on in step with the images.

        For the one writer, before its first slot. Gives the slots whose lines were missing.
        Raises DiskFullError, ArchiveError.
        """
        entered: list[datetime] = []
        with translated(self.directory):
            for day in self._days(since):
                entered += repair(day)
        return entered

    def days(self) -> list[date]:
        """The days that have a directory, in order. Raises ArchiveError."""
        with translated(self.directory):
            names = (day.relative_to(self.directory).parts for day in self._days(EPOCH))
            return [date(int(year), int(month), int(day)) for year, month, day in names]

    def day_directory(self, day: date) -> Path:
        """Where a day's pairs lie, or would."""
        return self.directory / f"{day:%Y/%m/%d}"

    def place(self, slot_utc: datetime, number: int) -> StoredPair:
        """Where a pair lies, or would."""
        main, sub = image_names(slot_utc.astimezone(UTC), number)
        folder = f"{FOLDER}/{slot_utc.astimezone(UTC):%Y/%m/%d}"
        return StoredPair(slot_utc, f"{folder}/{main}", f"{folder}/{sub}")

    def _days(self, since: datetime, last: datetime | None = None) -> Iterator[Path]:
        first = f"{since.astimezone(UTC):%Y/%m/%d}"
        end = "9999" if last is None else f"{last.astimezone(UTC):%Y/%m/%d}"
        days = self.directory.glob("[0-9][0-9][0-9][0-9]/[01][0-9]/[0-3][0-9]")
        for day in sorted(days):
            name = day.relative_to(self.directory).as_posix()
            if first <= name <= end and _is_date(name):
                yield day


def _take_back(path: Path) -> None:
    """Remove the first image of a pair that found no room: it would hold some for nothing."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _extra(
    pair: CapturedPair, captured_utc: datetime | None, sha256_main: str, sha256_sub: str
) -> dict[str, str]:
    cells = dict.fromkeys((name for name in EXTRA_COLUMNS if name != BURST), "")
    cells["skew_s"] = _text(pair.skew_s)
    cells["captured_utc"] = "" if captured_utc is None else instant_text(captured_utc)
    cells["sha256_main"], cells["sha256_sub"] = sha256_main, sha256_sub
    for role, frame in (("main", pair.main), ("sub", pair.sub)):
        state = camera_state(frame)
        cells[f"exposure_{role}_us"] = _text(state.exposure_us)
        cells[f"gain_{role}_db"] = _text(state.gain_db)
        cells[f"temperature_{role}_c"] = _text(state.temperature_c)
    return cells


def camera_state(frame: CapturedFrame) -> CameraState:
    """What a frame says of its camera."""
    return CameraState(frame.exposure_us, frame.gain_db, frame.temperature_c)


def _camera(cells: dict[str, str], role: str) -> CameraState:
    return CameraState(
        exposure_us=optional_number(cells.get(f"exposure_{role}_us")),
        gain_db=optional_number(cells.get(f"gain_{role}_db")),
        temperature_c=optional_number(cells.get(f"temperature_{role}_c")),
    )


def _verified(path: Path, expected: str | None) -> GreyImage:
    image = read_image(path)
    if expected and sha256(path.read_bytes()) != expected:
        msg = f"{path}: not the image that was stored (sha256 differs); restore it from a copy"
        raise FrameSetError(msg)
    return image


def _text(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _moment(text: str | None) -> datetime | None:
    try:
        return datetime.fromisoformat(text) if text else None
    except ValueError:
        return None


def _is_date(name: str) -> bool:
    try:
        date.fromisoformat(name.replace("/", "-"))
    except ValueError:
        return False
    return True


@contextmanager
def translated(directory: Path) -> Iterator[None]:
    """Turn the system's errors into the archive's, which say what to do."""
    try:
        yield
    except OSError as error:
        where = error.filename or directory
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            msg = f"{where}: the disk is full: free some space"
            raise DiskFullError(msg) from error
        msg = f"{where}: {error.strerror}: check permissions and the health of the disk"
        raise ArchiveError(msg) from error
