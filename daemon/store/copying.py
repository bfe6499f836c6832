"""A consistent copy of the database, made while others write to it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from daemon.durable import fsync_file, replacing
from daemon.errors import TO_SALVAGE, CopyError, DatabaseDamagedError, StoreError
from daemon.store.damage_note import SET_ASIDE
from daemon.store.sqlite import connect_readonly, is_damage, translate
from daemon.times import stamp_text

PAGES_A_STEP = 1024
"""4 MB between two syncs: a slot's own sync never waits behind more than that."""

_TABLES = {"alembic_version", "measurement"}

Tell = Callable[[int, int], None]
"""Hears how many pages are copied, and of how many."""


@dataclass(frozen=True, slots=True)
class Copied:
    """What a finished copy holds."""

    rows: int
    size_bytes: int
    last_slot_utc: datetime | None


def backup(source: Path, target: Path, tell: Tell = lambda _done, _total: None) -> Copied:
    """Copy a database consistently, while others write to it, into one checked, durable file.

    The copy appears under its name only when complete and found sound, and replaces an older one
    of that name. It shows the moment at which it began: the read transaction in which the steps
    are made keeps later commits out, and keeps no writer waiting (a log that grows meanwhile is
    emptied afterwards).
    Raises DatabaseDamagedError for a damaged original, CopyError for what the target's place says.
    """
    if target.exists() and target.samefile(source):
        msg = f"{target}: is the database itself: choose another name"
        raise StoreError(msg)
    try:
        original = connect_readonly(source)
    except sqlite3.Error as error:
        raise translate(source, error) from error
    with closing(original):
        return copy_out(original, source, target, tell)


def copy_out(
    original: sqlite3.Connection,
    source: Path,
    target: Path,
    tell: Tell = lambda _done, _total: None,
) -> Copied:
    """As `backup`, from an open connection: its file may have lost its name, `source`."""
    try:
        with replacing(target) as temporary:
            return _copy(original, source, temporary, tell)
    except OSError as error:
        msg = f"{target}: cannot write the backup ({error.strerror}): choose another place"
        raise CopyError(msg) from error
    except sqlite3.Error as error:
        if is_damage(error):  # the copy is new: damage is the original's
            raise translate(source, error) from error
        raise CopyError(str(translate(target, error))) from error


def rescue(held: sqlite3.Connection, path: Path, now_utc: datetime) -> Path:
    """Copy a database that lost its name `path` while it was open; give the copy's name.

    That is `path` if it is free, else the name of a database set aside.
    """
    target = path
    if target.exists():
        target = target.with_name(f"{SET_ASIDE}{stamp_text(now_utc)}")
    copy_out(held, path, target)
    if target == path:  # they belong to the removed file, whose commits the copy has
        for leftover in _companions(target):
            leftover.unlink(missing_ok=True)
    return target


def _copy(original: sqlite3.Connection, source: Path, temporary: Path, tell: Tell) -> Copied:
    temporary.write_bytes(b"")
    try:
        with closing(sqlite3.connect(temporary, isolation_level=None)) as copy:
            copy.execute("PRAGMA synchronous=OFF").close()  # synced here, and once complete
            _copy_pages(original, copy, temporary, tell)
            # Without a log of its own the copy can be read from a read-only medium.
            copy.execute("PRAGMA journal_mode=DELETE").close()
            return _checked(source, copy)
    finally:
        for leftover in _companions(temporary):
            leftover.unlink(missing_ok=True)


def _copy_pages(
    original: sqlite3.Connection, copy: sqlite3.Connection, temporary: Path, tell: Tell
) -> None:
    def step(_status: int, remaining: int, total: int) -> None:
        fsync_file(temporary)
        tell(total - remaining, total)

    original.execute("BEGIN").close()
    original.execute("SELECT count(*) FROM sqlite_master").close()  # the snapshot is taken now
    original.backup(copy, pages=PAGES_A_STEP, progress=step, sleep=0.0)
    original.execute("COMMIT").close()


def _checked(source: Path, copy: sqlite3.Connection) -> Copied:
    (finding,) = copy.execute("PRAGMA quick_check(1)").fetchone()
    if finding != "ok":
        msg = f"{source}: damaged ({finding.splitlines()[-1]}): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    rows, last = copy.execute("SELECT count(*), max(slot_utc) FROM measurement").fetchone()
    pages, page_bytes = (
        copy.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size")
    )
    last_slot_utc = None if last is None else datetime.fromisoformat(last)
    return Copied(rows, pages * page_bytes, last_slot_utc)


def require_replaceable(target: Path, *, force: bool) -> None:
    """Raise StoreError for a file that a backup must not replace.

    An older backup may be replaced; any other file only with `force`; a database in use never.
    """
    if not os.path.lexists(target):
        return
    if not target.is_file():
        msg = f"{target}: not a file: name the file that the backup shall become"
        raise StoreError(msg)
    if any(path.exists() for path in _companions(target)):
        msg = f"{target}: a database in use: choose another name"
        raise StoreError(msg)
    if not force and not is_backup(target):
        msg = f"{target}: exists and is no backup: choose another name, or say --force"
        raise StoreError(msg)


def is_backup(path: Path) -> bool:
    """Whether a file is a database of this program."""
    try:
        with closing(connect_readonly(path)) as connection:
            found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            return {name for (name,) in found} >= _TABLES
    except sqlite3.Error:
        return False


def _companions(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in ("-wal", "-shm", "-journal")]
