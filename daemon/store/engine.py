"""SQLAlchemy's engine over SQLite, with the transactions and errors that this program needs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError, SQLAlchemyError, StatementError
from sqlalchemy.pool import QueuePool

from daemon.errors import StoreError
from daemon.store.sqlite import connect, connect_readonly, said_plainly, translate


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
