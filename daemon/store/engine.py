"""SQLite as this program needs it: durable on every connection, and plain when it fails."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError, StatementError
from sqlalchemy.pool import QueuePool

from daemon.store.errors import (
    TO_SALVAGE,
    DamagedRowError,
    DatabaseBusyError,
    DatabaseDamagedError,
    DatabaseUnwritableError,
    DiskFullError,
    StoreError,
)

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


def database_exists(path: Path) -> bool:
    """Whether a database is there; an empty file is what a cut leaves of a database's making.

    Raises DatabaseDamagedError for a file that is none, DatabaseUnwritableError for one that
    may not be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(_MAGIC))
    except FileNotFoundError:
        return False
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror}): check its permissions"
        raise DatabaseUnwritableError(msg) from error
    if start and start != _MAGIC:
        msg = f"{path}: not a SQLite database: {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    return bool(start)


def make_engine(path: Path, *, readonly: bool = False) -> Engine:
    """Give an engine whose transactions begin as told by the option `dcam_begin`.

    Python's driver begins late and deferred, so that two writers could fail in the middle of a
    transaction: SQLite cannot wait for the write lock once a read lock is held. Writers say
    IMMEDIATE.
    """
    opener = connect_readonly if readonly else connect
    engine = create_engine("sqlite://", creator=lambda: opener(path), poolclass=QueuePool)

    def begin(connection: Connection) -> None:
        mode = connection.get_execution_options().get("dcam_begin", "DEFERRED")
        connection.exec_driver_sql(f"BEGIN {mode}")

    event.listen(engine, "begin", begin)
    return engine


@contextmanager
def translated(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into the store's, which say what to do."""
    try:
        yield
    except DamagedRowError as error:
        msg = f"{path}: damaged ({error}): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg) from error
    except DBAPIError as error:
        raise translate(path, error.orig) from error
    except StatementError as error:
        if isinstance(error.orig, ValueError):  # a value that no column can hold
            raise error.orig from None
        raise
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


def is_damage(error: BaseException | None) -> bool:
    """Whether SQLite's error says that the file itself is wrong."""
    return _code(error) in _DAMAGED or _NOT_TEXT in str(error)


def _code(error: BaseException | None) -> int:
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF  # the rest is SQLite's extension


def quick_check(path: Path) -> None:
    """Raise DatabaseDamagedError unless SQLite finds the file's pages consistent."""
    with translated(path), closing(connect(path)) as connection:
        findings = [str(row[0]) for row in connection.execute("PRAGMA quick_check(1)")]
    if findings != ["ok"]:
        what = findings[0].splitlines()[-1] if findings else "no answer"
        msg = f"{path}: damaged ({what}): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
