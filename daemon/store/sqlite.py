"""SQLite's own interface, without SQLAlchemy: connections that are durable, errors said plainly."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from daemon.errors import (
    TO_SALVAGE,
    DamagedRowError,
    DatabaseBusyError,
    DatabaseDamagedError,
    DatabaseMissingError,
    DatabaseUnwritableError,
    DiskFullError,
    StoreError,
)
from daemon.store.damage_note import read_note

FILE_NAME = "dcam.db"

BUSY_TIMEOUT_S = 10.0
"""A second writer (a command beside the daemon) holds the lock for milliseconds."""

_MAGIC = b"SQLite format 3\0"

_PRAGMAS: tuple[tuple[str, str, object], ...] = (
    ("journal_mode", "WAL", "wal"),
    ("synchronous", "FULL", 2),
    ("foreign_keys", "ON", 1),
)

_NOT_TEXT = "Could not decode to UTF-8"
"""Python's driver says this without a code."""

_DAMAGED = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
_BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_PROTOCOL}
_UNWRITABLE = {sqlite3.SQLITE_IOERR, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN}


def connect(path: Path) -> sqlite3.Connection:
    """Open for reading and writing, with every commit on the disk before it returns.

    `synchronous` is a property of the connection and not of the file, so it is set and read back
    each time (https://sqlite.org/pragma.html#pragma_synchronous). Raises StoreError when the
    file system cannot hold a write-ahead log.
    """
    connection = sqlite3.connect(
        path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
    )
    try:
        for name, value, wanted in _PRAGMAS:
            _set_and_assert(connection, path, name, value, wanted)
    except BaseException:
        connection.close()
        raise
    return connection


def _set_and_assert(
    connection: sqlite3.Connection, path: Path, name: str, value: str, wanted: object
) -> None:
    connection.execute(f"PRAGMA {name}={value}").close()
    (found,) = connection.execute(f"PRAGMA {name}").fetchone()
    if found != wanted:
        msg = f"{path}: SQLite refuses {name}={value}: put the state on a local disk"
        raise StoreError(msg)


def connect_readonly(path: Path) -> sqlite3.Connection:
    """Open for reading only, beside a running daemon or without one.

    A WAL database that nobody has open needs a writable directory even for reading; where there
    is none, and no log is left to replay, the file is read as it stands.
    """
    log = path.with_name(path.name + "-wal")
    as_it_stands = not log.exists() and not os.access(path.parent, os.W_OK)
    query = "immutable=1" if as_it_stands else "mode=ro"
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{query}",
        uri=True,
        timeout=BUSY_TIMEOUT_S,
        isolation_level=None,
        check_same_thread=False,
    )
    connection.execute("PRAGMA query_only=ON").close()
    return connection


def undo_half_made(path: Path) -> None:
    """Roll back what a cut left of a database's making, before it had a log: no reader may.

    Whatever else is wrong with it, those who read it next find.
    """
    if path.is_file() and path.with_name(path.name + "-journal").exists():
        with (
            suppress(sqlite3.Error),
            closing(sqlite3.connect(path, timeout=BUSY_TIMEOUT_S)) as connection,
        ):
            connection.execute("PRAGMA user_version").fetchone()


def database_exists(path: Path) -> bool:
    """Whether a database is there; an empty file is what a cut leaves of a database's making.

    Raises DatabaseDamagedError for a file that is none, and as long as one is being salvaged;
    DatabaseUnwritableError for one that may not be read.
    """
    note = read_note(path.parent)
    if note is not None and note.aside is not None:
        msg = f"{path}: damaged, and its salvage is not complete: restart dcamd, it goes on with it"
        raise DatabaseDamagedError(msg)
    if path.is_dir():
        msg = f"{path}: a directory and not a database: {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    start = _beginning(path)
    if start and start != _MAGIC:
        msg = f"{path}: not a SQLite database: {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    return bool(start)


def existing_path(directory: Path) -> Path:
    """The database of a state directory. Raises as `database_exists`, and DatabaseMissingError."""
    path = directory / FILE_NAME
    if not database_exists(path):
        msg = f"{path}: no database: start dcamd once, or name another state directory"
        raise DatabaseMissingError(msg)
    return path


def is_database_file(path: Path) -> bool:
    """Whether a file begins as a SQLite database. Raises DatabaseUnwritableError."""
    return _beginning(path) == _MAGIC


def _beginning(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(len(_MAGIC))
    except FileNotFoundError:
        return b""
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror}): check its permissions"
        raise DatabaseUnwritableError(msg) from error


@contextmanager
def said_plainly(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into the store's, which say what to do."""
    try:
        yield
    except DamagedRowError as error:
        msg = f"{path}: damaged ({error}): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg) from error
    except sqlite3.Error as error:
        raise translate(path, error) from error


def translate(path: Path, error: BaseException | None) -> StoreError:
    """Give the store's error for one of SQLite's: what to do follows from its code."""
    code = _code(error)
    if is_damage(error):
        return DatabaseDamagedError(f"{path}: damaged ({error}): {TO_SALVAGE}")
    if code in _BUSY:
        return DatabaseBusyError(
            f"{path}: another program holds it locked ({error}): close that program"
        )
    if code == sqlite3.SQLITE_FULL:
        return DiskFullError(f"{path}: the disk is full: free some space")
    if code in _UNWRITABLE:
        return DatabaseUnwritableError(
            f"{path}: {error}: check permissions and the health of the disk"
        )
    return StoreError(f"{path}: {error}")


def any_text(content: bytes) -> str:
    """Text that may be damaged: as it is no UTF-8, its row's digest will not fit."""
    return content.decode(errors="surrogateescape")


def is_damage(error: BaseException | None) -> bool:
    """Whether SQLite's error says that the file itself is wrong."""
    return _code(error) in _DAMAGED or _NOT_TEXT in str(error)


def _code(error: BaseException | None) -> int:
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF  # the rest is SQLite's extension
