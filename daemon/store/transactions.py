"""An open database: who it belongs to, and its transactions."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self, cast

from sqlalchemy import Engine
from sqlalchemy.orm import Session

from daemon.errors import DatabaseDamagedError
from daemon.store.engine import translated
from daemon.store.integrity.digest import CheckedSession


class Transactions:
    """What every question to a database, and every change of it, goes through."""

    def __init__(self, path: Path, engine: Engine) -> None:
        self.path = path
        self.damage: DatabaseDamagedError | None = None
        """What was met first of the file's damage; whoever opened it should close and end."""
        self._engine = engine
        self._writer = engine.execution_options(dcam_begin="IMMEDIATE")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections; the last one empties the write-ahead log."""
        self._engine.dispose()

    @contextmanager
    def _session(self) -> Iterator[Session]:
        """A transaction for reading objects."""
        with self._translated(), CheckedSession(self._engine) as session:
            yield session

    @contextmanager
    def _read(self) -> Iterator[sqlite3.Connection]:
        """A transaction for reading by plain SQL."""
        with self._session() as session:
            driver = session.connection().connection.dbapi_connection
            yield cast("sqlite3.Connection", driver)

    @contextmanager
    def _write(self) -> Iterator[Session]:
        """A transaction that is on the disk when the block has ended, or has changed nothing."""
        with self._translated(), CheckedSession(self._writer) as session, session.begin():
            yield session

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            with translated(self.path):
                yield
        except DatabaseDamagedError as error:
            self.damage = self.damage or error
            raise
