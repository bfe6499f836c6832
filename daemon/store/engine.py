"""SQLAlchemy's engine over SQLite, with the transactions and errors that this program needs."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError, SQLAlchemyError, StatementError
from sqlalchemy.pool import QueuePool

from daemon.errors import DatabaseRemovedError, StoreError
from daemon.store.sqlite import connect, connect_readonly, said_plainly, translate


def make_engine(path: Path, *, readonly: bool = False) -> Engine:
    """Give an engine whose transactions begin as set by the option `dcam_begin`.

    Python's driver begins late and deferred, so that two writers could fail in the middle of a
    transaction: SQLite cannot wait for the write lock once a read lock is held. Writers say
    IMMEDIATE.
    """
    place = _Place(path)

    def open_connection() -> sqlite3.Connection:
        if readonly:
            return connect_readonly(path)
        place.require_same_file()
        connection = connect(path)
        place.remember()
        return connection

    engine = create_engine("sqlite://", creator=open_connection, poolclass=QueuePool)

    def begin(connection: Connection) -> None:
        mode = connection.get_execution_options().get("dcam_begin", "DEFERRED")
        if mode == "IMMEDIATE":
            place.require_same_file()
        connection.exec_driver_sql(f"BEGIN {mode}")

    event.listen(engine, "begin", begin)
    return engine


class _Place:
    """The name of the file that is open: somebody may remove it, or put another in its place.

    SQLite goes on writing into the removed file then, and says nothing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: tuple[int, int] | None = None
        """Device and inode of what was opened first."""

    def remember(self) -> None:
        self._file = self._file or self._now()

    def require_same_file(self) -> None:
        """Raise DatabaseRemovedError if the name no longer leads to the open file."""
        if self._file is None or (now := self._now()) == self._file:
            return
        what = "removed or renamed" if now is None else "replaced by another file"
        msg = f"{self._path}: {what} while it was in use: dcamd writes what it held to the disk"
        raise DatabaseRemovedError(msg)

    def _now(self) -> tuple[int, int] | None:
        try:
            found = self._path.stat()
        except FileNotFoundError:
            return None
        except OSError:  # a failing disk does not say that the name is gone
            return self._file
        return found.st_dev, found.st_ino


@contextmanager
def translated(path: Path) -> Iterator[None]:
    """Turn SQLAlchemy's and SQLite's errors into the store's, which say what to do."""
    try:
        with said_plainly(path):
            yield
    except DBAPIError as error:
        raise translate(path, error.orig) from error
    except StatementError as error:
        if isinstance(error.orig, ValueError):  # a value that no column can hold
            raise error.orig from None
        msg = f"{path}: {error}"
        raise StoreError(msg) from error
    except SQLAlchemyError as error:
        msg = f"{path}: {error}"
        raise StoreError(msg) from error
