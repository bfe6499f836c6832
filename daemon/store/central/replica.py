"""One site's record, fetched from the central database into a SQLite file of the usual kind.

Whatever reads a pier's database reads this one: rows come with the digests that the pier gave
them, so that a value that was changed on its way is noticed. What is there is fetched once.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, select

from daemon.durable import write_durable
from daemon.store.central.connecting import Central
from daemon.store.central.tables import CHANGING, EVENT, MEASUREMENT, MIRRORED, to_sqlite
from daemon.store.database import open_store
from daemon.store.queries.columns import Tell
from daemon.store.sqlite import FILE_NAME, connect

_BATCH = 5000


def fetch_site(
    central: Central,
    site: Mapping[str, Any],
    directory: Path,
    tell: Tell = lambda _done, _total: None,
) -> int:
    """Bring a copy of a site's record up to date; give how many rows came.

    It begins again where rows of the site have changed since. Raises StoreError, OSError.
    """
    noted = directory / "site.json"
    known = {"identity": site["identity"], "rewritten": site["rewritten"]}
    if not noted.exists() or json.loads(noted.read_bytes()) != known:
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
        open_store(directory).close()
    with closing(connect(directory / FILE_NAME)) as copy, central.transaction() as connection:
        for table in MIRRORED:
            _mirror(connection, copy, table, site["id"])
        _append(connection, copy, EVENT, site["id"], lambda _done, _total: None)
        rows = _append(connection, copy, MEASUREMENT, site["id"], tell)
    write_durable(noted, json.dumps(known).encode())
    return rows


def _append(
    connection: Connection, copy: sqlite3.Connection, table: Table, site_id: int, tell: Tell
) -> int:
    (last,) = copy.execute(f"SELECT coalesce(max(id), 0) FROM {table.name}").fetchone()  # noqa: S608 - our own names
    query = select(table).where(table.c.site_id == site_id, table.c.id > last).order_by(table.c.id)
    count = 0
    for rows in _batches(connection, query, table):
        _insert(copy, table.name, rows)
        count += len(rows)
        tell(count, count)
    return count


def _mirror(connection: Connection, copy: sqlite3.Connection, table: Table, site_id: int) -> None:
    """Whoever reads meanwhile sees the table as it was, or as it is now."""
    query = select(table).where(table.c.site_id == site_id)
    found = [row for rows in _batches(connection, query, table) for row in rows]
    copy.execute("BEGIN IMMEDIATE").close()
    if table.name in CHANGING:
        copy.execute(f"DELETE FROM {table.name}").close()  # noqa: S608 - our own names
    if found:
        _add(copy, table.name, found)
    copy.execute("COMMIT").close()


def _batches(connection: Connection, query: Any, table: Table) -> Iterator[list[dict[str, Any]]]:
    with connection.execution_options(yield_per=_BATCH).execute(query) as found:
        for part in found.mappings().partitions():
            yield [to_sqlite(table, dict(row)) for row in part]


def _insert(copy: sqlite3.Connection, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
    copy.execute("BEGIN IMMEDIATE").close()
    _add(copy, table, rows)
    copy.execute("COMMIT").close()


def _add(copy: sqlite3.Connection, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
    names = list(rows[0])
    places = ", ".join("?" * len(names))
    query = f"INSERT OR IGNORE INTO {table} ({', '.join(names)}) VALUES ({places})"  # noqa: S608
    copy.executemany(query, ([row[name] for name in names] for row in rows)).close()
