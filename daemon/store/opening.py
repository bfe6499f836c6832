"""How dcamd opens its database: checked, and if it is damaged salvaged, so that slots go on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

import structlog

from daemon.errors import DatabaseRemovedError, DatabaseUnwritableError, StoreError
from daemon.store.damage_note import Note, clear_note, note_damage, read_note
from daemon.store.database import Store, open_store
from daemon.store.salvage.damage import (
    Depth,
    ended_in_order,
    find_damage,
    traces_of_a_lost_database,
)
from daemon.store.salvage.salvage import Tell, salvage
from daemon.store.sqlite import FILE_NAME, undo_half_made

_log = structlog.get_logger("dcam.daemon")


def open_checked_store(
    directory: Path, now_utc: datetime | None = None, tell: Tell = lambda _done, _total: None
) -> Store:
    """Open the database of a state directory for dcamd, which alone may set it aside.

    How much is looked at follows from how it was left: see `Depth`. A damaged one is salvaged, with
    `tell` hearing how far that is. Raises StoreError: newer, of another program, busy, disk full or
    failing.
    """
    path = directory / FILE_NAME
    undo_half_made(path)
    try:
        note = read_note(directory)
        why = note.why if note and note.aside else _damage(path, note)
        if why is not None:
            salvage(path, why, now_utc or datetime.now(UTC), tell)
        elif note is not None:
            _log.warning("database_sound_after_all", noted=note.why)
            clear_note(directory)
    except OSError as error:
        msg = f"{path}: damaged, and cannot be salvaged ({error}): look at the disk"
        raise DatabaseUnwritableError(msg) from error
    return open_store(directory, now_utc=now_utc, checked=True)


@contextmanager
def damage_noted(store: Store) -> Iterator[None]:
    """Note damage that was met within the block, so that the next start looks at everything.

    SQLite finds only a part of what a row's checksum shows.
    """
    try:
        yield
    finally:
        if isinstance(store.damage, DatabaseRemovedError):
            _rescue(store)
        if store.damage is not None:
            with suppress(OSError):
                note_damage(store.path.parent, str(store.damage))


def _rescue(store: Store) -> None:
    """Nothing acknowledged is lost as long as the removed file is still open."""
    try:
        target = store.rescue(datetime.now(UTC))
    except StoreError as error:
        _log.error("database_not_rescued", error=str(error))
    else:
        _log.error("database_rescued", why=str(store.damage), written_to=str(target))


def _damage(path: Path, note: Note | None) -> str | None:
    """What is wrong with the database, if anything."""
    if not path.exists() or (path.is_file() and not path.stat().st_size):
        # An empty file is what a cut leaves of a database's making, as long as there was nothing.
        traces = traces_of_a_lost_database(path)
        return f"{'empty' if path.exists() else 'missing'} beside {traces}" if traces else None
    depth = Depth.EVERYTHING if note else Depth.NEWEST if ended_in_order(path) else Depth.PAGES
    try:
        return find_damage(path, depth)
    except DatabaseUnwritableError as error:
        # One failure of the disk may pass; at the next start it is damage like any other.
        if note is not None:
            return str(error)
        note_damage(path.parent, str(error))
        raise
