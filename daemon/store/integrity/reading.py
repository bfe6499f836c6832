"""Plain SQL over an open connection: rows that prove themselves, and single values."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from typing import Any

from daemon.store.integrity.checksum import DIGEST, not_as_written, require_intact
from daemon.store.integrity.checksum_columns import damaged_rows


def whole_rows(
    connection: sqlite3.Connection, table: str, query: str, *parameters: object
) -> list[dict[str, Any]]:
    """Rows by column, as SQLite holds them, all columns of a table. Raises DamagedRowError."""
    # A cursor of its own: the connection may be another's, who reads plain tuples.
    with closing(connection.cursor()) as cursor:
        cursor.row_factory = sqlite3.Row
        rows = [dict(row) for row in cursor.execute(query, parameters)]
    for row in rows:
        require_intact(table, row, row.pop(DIGEST))
    return rows


def proved_rows(
    connection: sqlite3.Connection, table: str, query: str, *parameters: object
) -> list[dict[str, Any]]:
    """Many rows by column with their digests, all columns of a table. Raises DamagedRowError."""
    with closing(connection.execute(query, parameters)) as cursor:
        names = [column[0] for column in cursor.description]
        rows = cursor.fetchall()
    if not rows:
        return []
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    for place in damaged_rows(table, columns):
        raise not_as_written(table, dict(zip(names, rows[place], strict=True)))
    return [dict(zip(names, row, strict=True)) for row in rows]


def fetch(connection: sqlite3.Connection, query: str, *parameters: object) -> list[Any]:
    """All rows that a query gives, as tuples."""
    with closing(connection.cursor()) as cursor:
        return cursor.execute(query, parameters).fetchall()


def value(connection: sqlite3.Connection, query: str, *parameters: object) -> Any:
    """The first column of the first row; None without a row."""
    found = fetch(connection, query, *parameters)
    return found[0][0] if found else None
