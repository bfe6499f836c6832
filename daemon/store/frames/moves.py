"""Pairs that a wrong clock had filed under the wrong slot go to their own.

First they are linked to their new place, then the row changes, then the old place is cleared: at
each instant the row's frames are where it says.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from daemon.durable import fsync_directory, make_directory_durable
from daemon.errors import SlotTakenError
from daemon.store.frames.archive import FrameArchive, StoredPair, translated
from daemon.store.frames.table import EXTRA_COLUMNS, append_row, find, image_names, remove_rows
from daemon.times import instant_text
from drivers.frameset import BURST, READING, FrameSetRow


def link_pairs(
    source: FrameArchive,
    from_slot_utc: datetime,
    target: FrameArchive,
    slot_utc: datetime,
    captured_utc: datetime,
) -> StoredPair | None:
    """Give a slot's pairs a second place, durably; gives the first one's, None if there is none.

    May be repeated. Both archives lie on one file system. Raises DiskFullError, ArchiveError.
    """
    numbers = source.numbers(from_slot_utc)
    for number in numbers:
        old, new = source.place(from_slot_utc, number), target.place(slot_utc, number)
        main, sub = target.state / new.main_path, target.state / new.sub_path
        with translated(main.parent):
            make_directory_durable(main.parent)
            _link(source.state / old.main_path, main)
            _link(source.state / old.sub_path, sub)
            fsync_directory(main.parent)
            if find(main.parent, slot_utc, number) is None:
                known = find((source.state / old.main_path).parent, from_slot_utc, number) or {}
                extra = {name: known.get(name, "") for name in EXTRA_COLUMNS if name != BURST}
                extra |= {name: text for name, text in known.items() if name.startswith(READING)}
                extra["captured_utc"], extra[BURST] = instant_text(captured_utc), str(number)
                row = FrameSetRow(slot_utc, "measure", main.name, sub.name, extra=extra)
                append_row(main.parent, row)
    return target.place(slot_utc, numbers[0]) if numbers else None


def clear_pairs(archive: FrameArchive, slot_utc: datetime) -> None:
    """Remove a slot's pairs from the place where they were; may be repeated.

    Raises DiskFullError, ArchiveError.
    """
    day = (archive.state / archive.place(slot_utc, 1).main_path).parent
    with translated(day):
        numbers = archive.numbers(slot_utc)
        if day.is_dir():
            remove_rows(day, slot_utc)
        for number in numbers:
            for name in image_names(slot_utc.astimezone(UTC), number):
                (day / name).unlink(missing_ok=True)


def remove_if_empty(archive: FrameArchive) -> None:
    """Remove an archive's directory once no pair is in it, with its tables."""
    if archive.stored_slots() or not archive.state.is_dir():
        return
    for path in sorted(archive.state.rglob("*"), reverse=True):
        if path.is_dir():
            path.rmdir()
        else:
            path.unlink()
    archive.state.rmdir()


def _link(source: Path, target: Path) -> None:
    try:
        target.hardlink_to(source)
    except FileExistsError:
        if not source.samefile(target):
            msg = f"{target}: there already, and not the image of {source.name}; look at both"
            raise SlotTakenError(msg) from None
