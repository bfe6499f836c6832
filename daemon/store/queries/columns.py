"""Rows of `measurement` in bulk, as columns: for tables and figures of many months.

Plain SQL: an object a row would cost several times what reading it does.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from core.arrays import FloatArray
from daemon.store.integrity.checksum import not_as_written
from daemon.store.integrity.checksum_columns import damaged_rows
from daemon.store.rows.datum import Datums, columns_in_record_zero, read_datums
from daemon.store.runs import next_second
from daemon.store.sqlite import any_text, connect_readonly, is_damage, said_plainly
from daemon.times import slot_text

BATCH = 5000
"""Rows that stand in memory together: some 20 MB."""

MEASUREMENT = "measurement"

Tell = Callable[[int, int], None]
"""Hears how many rows are read, and of how many."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Consecutive rows, column by column, as SQLite holds them; each has proved itself."""

    values: Mapping[str, Sequence[Any]]
    """By the column's name; all are equally long."""

    def __len__(self) -> int:
        return len(self.values["slot_utc"])

    def rows(self) -> Iterator[dict[str, Any]]:
        """The values of each row by column."""
        for row in zip(*self.values.values(), strict=True):
            yield dict(zip(self.values, row, strict=True))

    def numbers(self, *names: str) -> FloatArray:
        """(rows, names) of numbers; NaN for NULL."""
        return np.array([self.values[name] for name in names], dtype=np.float64).T


def read_columns(
    path: Path,
    since: datetime,
    until: datetime,
    tell: Tell = lambda _done, _total: None,
    *,
    as_stored: bool = False,
) -> Iterator[Columns]:
    """Rows with since <= slot < until, in the order of their slots, many at a time.

    In the record's zero; `as_stored` leaves each counting from its own calibration's reference.

    Each batch is a transaction of its own: a slow reader keeps neither memory nor the write-ahead
    log. Raises DatabaseDamagedError, which names the first row that is not what was written.
    """
    limits = [slot_text(next_second(time)) for time in (since, until)]
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        within = "slot_utc >= ? AND slot_utc < ?"
        count = f"SELECT count(*) FROM measurement WHERE {within}"  # noqa: S608 - our own words
        total, done = connection.execute(count, limits).fetchone()[0], 0
        tell(done, total)
        query = f"SELECT * FROM measurement WHERE {within} ORDER BY slot_utc LIMIT {BATCH}"  # noqa: S608
        datums: Datums = {}
        while batch := _batch(connection, query, limits):
            if not as_stored:  # a link made since must not move the zero within one table
                datums = {**read_datums(connection), **datums}
                batch = Columns(columns_in_record_zero(batch.values, datums))
            yield batch
            done += len(batch)
            tell(done, max(total, done))  # the daemon may have added rows since
            if len(batch) < BATCH:
                return
            query = query.replace(">=", ">")
            limits[0] = batch.values["slot_utc"][-1]


def target_roles(path: Path, since: datetime, until: datetime) -> dict[str, str]:
    """The role of each further target that rows with since <= slot < until name.

    In the order of the config, those of the newest row first. Damaged rows are passed over: who
    reads them is given the error. Raises StoreError.
    """
    query = (
        "SELECT json_extract(targets, found.fullkey || '.name'),"
        " json_extract(targets, found.fullkey || '.role'), max(slot_utc), found.key"
        " FROM measurement,"
        " json_each(CASE WHEN json_valid(targets) THEN targets ELSE '[]' END) AS found"
        " WHERE targets IS NOT NULL AND slot_utc >= ? AND slot_utc < ?"
        " GROUP BY 1 ORDER BY 3 DESC, 4"
    )
    limits = [slot_text(next_second(time)) for time in (since, until)]
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.text_factory = any_text
        _, rows = _fetch(connection, query, limits)
    return {name: str(role) for name, role, _, _ in rows if isinstance(name, str)}


def _batch(connection: sqlite3.Connection, query: str, limits: Sequence[str]) -> Columns | None:
    try:
        names, rows = _fetch(connection, query, limits)
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise
        connection.text_factory = any_text  # so that a row whose text is damaged can be named
        names, rows = _fetch(connection, query, limits)
    if not rows:
        return None
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    for place in damaged_rows(MEASUREMENT, columns):
        row = dict(zip(names, rows[place], strict=True))
        raise not_as_written(MEASUREMENT, row)
    return Columns(columns)


def _fetch(
    connection: sqlite3.Connection, query: str, limits: Sequence[str]
) -> tuple[list[str], list[tuple[Any, ...]]]:
    with closing(connection.execute(query, limits)) as cursor:
        return [column[0] for column in cursor.description], cursor.fetchall()
