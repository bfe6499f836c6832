"""Rows from the pages of a damaged database into the tables of a new one."""

from __future__ import annotations

import ast
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

from daemon.store.integrity.checksum import DIGEST, row_digest
from daemon.store.salvage.sqlite_pages import PageFile, RawRow, Value

Values = dict[str, Value]

_KINDS: dict[str, type] = {"TEXT": str, "INTEGER": int, "BOOLEAN": int, "FLOAT": float}
_DEFINITIONS = frozenset({"table", "index", "trigger"})
"""What a row of SQLite's own table of tables begins with."""
_BATCH = 1000
WAITING = "undated"
"""The one table that rows leave again."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column, as SQLite tells of it."""

    name: str
    kind: type
    needed: bool
    """A row without it is none."""
    default: Value
    is_rowid: bool


@dataclass(frozen=True, slots=True)
class Table:
    """A table that rows are carried over into."""

    name: str
    columns: tuple[Column, ...]
    has_digests: bool
    """Whether its rows prove themselves; those of older revisions can only be plausible."""

    def fitted(self, row: RawRow) -> Values | None:
        """A row of this table as its columns; None when it is no row of it, or not whole."""
        if len(row.values) > len(self.columns):
            return None
        values: Values = {}
        for index, column in enumerate(self.columns):
            value = row.values[index] if index < len(row.values) else column.default
            if column.is_rowid and value is None:
                value = row.rowid
            elif column.kind is float and isinstance(value, int):
                value = float(value)
            if value is None and column.needed:
                return None
            values[column.name] = value
        if self.has_digests:
            return values if row_digest(self.name, values) == values[DIGEST] else None
        return values if self._is_plausible(row, values) else None

    def _is_plausible(self, row: RawRow, values: Values) -> bool:
        return not row.guessed and all(
            values[column.name] is None or isinstance(values[column.name], column.kind)
            for column in self.columns
        )


@dataclass(slots=True)
class Carried:
    """What came out of a damaged database."""

    rows: Counter[str] = field(default_factory=Counter)
    """Rows carried over, by table."""
    gaps: list[Values] = field(default_factory=list)
    """Still to be entered: where slots are missed, measured ones come first."""
    rejected: int = 0
    """Rows that are not what was written."""
    unreadable_pages: int = 0


def tables_of(connection: sqlite3.Connection) -> list[Table]:
    """The program's tables of a new database, of whatever revision."""
    query = (
        "SELECT name FROM sqlite_master WHERE type = 'table'"
        " AND name NOT LIKE 'sqlite_%' AND name <> 'alembic_version'"
    )
    names = [name for (name,) in connection.execute(query)]
    tables = ((name, tuple(_columns(connection, name))) for name in names)
    return [
        Table(name, columns, any(column.name == DIGEST for column in columns))
        for name, columns in tables
    ]


def _columns(connection: sqlite3.Connection, table: str) -> Iterator[Column]:
    for _, name, kind, needed, default, key in connection.execute(f"PRAGMA table_info({table})"):
        yield Column(
            name=name,
            kind=_KINDS.get(kind, object),
            needed=bool(needed or key or name == DIGEST),
            default=None if default is None else ast.literal_eval(default),
            is_rowid=bool(key) and kind == "INTEGER",
        )


def carry_over(
    pages: PageFile, target: sqlite3.Connection, tell: Callable[[int, int], None]
) -> Carried:
    """Put every row that proves itself into the tables of a new database; gaps are only read.

    Newest versions of pages first; older ones give what those do not. Raises sqlite3.Error.
    """
    tables = tables_of(target)
    carried = Carried()
    target.execute("PRAGMA foreign_keys=OFF").close()  # a row stays though its calibration is lost
    target.execute("BEGIN").close()
    for is_newest, rows in ((True, pages.rows(tell)), (False, pages.older_rows())):
        while batch := list(islice(rows, _BATCH)):
            found = [(row, _recognised(tables, row)) for row in batch]
            if not is_newest:  # a pair that was dated since must not wait for its slot again
                found = [(row, known) for row, known in found if known and known[0].name != WAITING]
            _insert(target, (known for _, known in found if known), carried)
            if is_newest:
                carried.rejected += sum(known is None and _counts(row) for row, known in found)
    target.execute("COMMIT").close()
    carried.unreadable_pages = pages.unreadable
    return carried


def _recognised(tables: list[Table], row: RawRow) -> tuple[Table, Values] | None:
    for table in tables:
        values = table.fitted(row)
        if values is not None:
            return table, values
    return None


def _counts(row: RawRow) -> bool:
    """Whether a row that is none of ours was one: not SQLite's own, nor the revision."""
    return not row.guessed and len(row.values) > 1 and row.values[0] not in _DEFINITIONS


def _insert(
    target: sqlite3.Connection, found: Iterable[tuple[Table, Values]], carried: Carried
) -> None:
    by_table: dict[str, list[Values]] = {}
    for table, values in found:
        by_table.setdefault(table.name, []).append(values)
    carried.gaps += by_table.pop("gap", [])
    for name, rows in by_table.items():
        names = list(rows[0])
        columns, places = ", ".join(names), ", ".join(f":{name}" for name in names)
        before = target.total_changes
        statement = f"INSERT OR IGNORE INTO {name} ({columns}) VALUES ({places})"  # noqa: S608
        target.executemany(statement, rows).close()
        carried.rows[name] += target.total_changes - before
