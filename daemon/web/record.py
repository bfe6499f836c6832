"""The record, read only: each question is one short transaction, opened and closed."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path

from daemon.errors import StoreError
from daemon.store.queries.overview import Overview
from daemon.store.queries.record_view import frame_name
from daemon.store.revisions import require_head
from daemon.store.sqlite import connect_readonly, existing_path, said_plainly

FOLDER = "frames"
"""As `daemon.store.frames.archive`, which loads OpenCV."""


class Record:
    """The database and the frames of a state directory."""

    def __init__(self, state: Path) -> None:
        self.state = state

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """One transaction for reading. Raises StoreError, which says what to do."""
        path = existing_path(self.state)
        with said_plainly(path), closing(connect_readonly(path)) as connection:
            connection.execute("BEGIN").close()
            require_head(Overview(connection).revision(), path)
            yield connection

    def frame(self, slot_utc: datetime, role: str) -> Path | None:
        """The frame that a slot's row names, if it is there, and within the archive."""
        with self.reading() as connection:
            name = frame_name(connection, slot_utc, role)
        if name is None:
            return None
        archive = (self.state / FOLDER).resolve()
        path = (self.state / name).resolve()
        if path.suffix != ".png" or not path.is_relative_to(archive) or not path.is_file():
            return None
        return path

    def span(self) -> tuple[datetime, datetime] | None:
        """The first and the last slot that is accounted for; None where nothing can be read."""
        try:
            with self.reading() as connection:
                return Overview(connection).accounted()
        except StoreError:
            return None
