"""Rows in the order in which they were written, late ones too: for who passes each on once.

Ids grow in that order. But a row that was taken out lets the next one have its id, a copy that was
put back ends earlier, and a row whose time was put right is another one to who knows slots: so a
reader compares what it was given with what stands there now.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from daemon.store.integrity.reading import fetch, proved_rows, value, whole_rows
from daemon.store.queries.overview import Overview
from daemon.store.revisions import require_head
from daemon.store.rows.datum import columns_in_record_zero, read_datums
from daemon.store.runs import next_second
from daemon.store.sqlite import connect_readonly, existing_path, said_plainly
from daemon.times import slot_text


@dataclass(frozen=True, slots=True)
class Arrival:
    """A row: in the record's zero, or as it is stored."""

    row_id: int
    slot: str
    """As `daemon.times.slot_text` writes it."""
    values: Mapping[str, Any]
    """By column, as SQLite holds them."""


@contextmanager
def open_arrivals(directory: Path, *, as_stored: bool = False) -> Iterator[Arrivals]:
    """Look at the rows of a state directory, all at one instant, beside a running daemon.

    `as_stored` gives each as the table holds it, with its digest, and not in the record's zero.
    Raises StoreError, also within the block; what cannot be read yet may be tried again.
    """
    path = existing_path(directory)
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.execute("BEGIN").close()
        require_head(Overview(connection).revision(), path)
        yield Arrivals(connection, as_stored=as_stored)


class Arrivals:
    """Questions to a connection; its owner begins the transaction and ends it."""

    def __init__(self, connection: sqlite3.Connection, *, as_stored: bool = False) -> None:
        self.connection = self._connection = connection
        self._as_stored = as_stored

    def newest_id(self) -> int:
        """Of the row that was written last; 0 without rows."""
        return int(value(self._connection, "SELECT max(id) FROM measurement") or 0)

    def id_before(self, since: datetime) -> int:
        """Of the row before all that were written of slots from `since` on."""
        query = "SELECT min(id) FROM measurement WHERE slot_utc >= ?"
        first = value(self._connection, query, slot_text(next_second(since)))
        return self.newest_id() if first is None else int(first) - 1

    def after(self, row_id: int, limit: int) -> list[Arrival]:
        """The next rows. Raises DamagedRowError."""
        query = "SELECT * FROM measurement WHERE id > ? ORDER BY id LIMIT ?"
        return self._rows(query, row_id, limit)

    def with_ids(self, row_ids: Sequence[int]) -> list[Arrival]:
        """These rows, in this order. Raises DamagedRowError."""
        query = "SELECT * FROM measurement WHERE id = ?"
        return [row for row_id in row_ids for row in self._rows(query, row_id)]

    def latest(self) -> Arrival | None:
        """The row of the latest slot. Raises DamagedRowError."""
        query = "SELECT * FROM measurement ORDER BY slot_utc DESC LIMIT 1"
        return next(iter(self._rows(query)), None)

    def slot_of(self, row_id: int) -> tuple[str, bool] | None:
        """The slot of a row, and whether its time was put right; None where there is no row."""
        query = "SELECT slot_utc, redated_from_utc IS NOT NULL FROM measurement WHERE id = ?"
        found = fetch(self._connection, query, row_id)
        return (found[0][0], bool(found[0][1])) if found else None

    def redated(self, until_id: int) -> list[tuple[int, str]]:
        """Ids and slots of rows whose time was put right, up to an id."""
        query = (
            "SELECT id, slot_utc FROM measurement"
            " WHERE redated_from_utc IS NOT NULL AND id <= ? ORDER BY id"
        )
        return fetch(self._connection, query, until_id)

    def _rows(self, query: str, *parameters: object) -> list[Arrival]:
        if self._as_stored:
            stored = proved_rows(self._connection, "measurement", query, *parameters)
            return [Arrival(row["id"], row["slot_utc"], row) for row in stored]
        rows = whole_rows(self._connection, "measurement", query, *parameters)
        if not rows:
            return []
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        moved = columns_in_record_zero(columns, read_datums(self._connection))
        return [
            Arrival(row["id"], row["slot_utc"], row)
            for row in (
                dict(zip(moved, line, strict=True)) for line in zip(*moved.values(), strict=True)
            )
        ]
