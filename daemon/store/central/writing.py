"""What a pier writes into the central database: each step one transaction, with how far it came.

How far a site has come stands in its central row and changes with the rows themselves: a cut at
any moment leaves both as they were before or after, and a central database that was put back is
filled again from where it ends.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, delete, func, select, text, tuple_, update
from sqlalchemy.dialects.postgresql import insert

from daemon.errors import StoreError
from daemon.store.central.connecting import Central
from daemon.store.central.site_table import SITE
from daemon.store.central.tables import (
    CHANGING,
    DIGEST_PART,
    EVENT,
    MEASUREMENT,
    MIRRORED,
    from_sqlite,
    key_of,
)
from daemon.store.integrity.reading import fetch, proved_rows, value
from daemon.store.queries.arrivals import Arrival, open_arrivals
from daemon.store.queries.progress import Progress
from daemon.store.records import Mark
from daemon.store.revisions import REVISIONS
from daemon.version import VERSION

BATCH = 1000
"""Rows, or events, of one transaction."""


@dataclass(frozen=True, slots=True)
class SiteFacts:
    """What a pier says of itself."""

    name: str
    period_s: int
    position_deg: tuple[float, float] | None = None
    """Latitude, longitude."""
    config: str | None = None
    """What of its config others may read, as TOML."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """How a pier says it is, in short."""

    level: int
    summary: str
    alarms: int | None
    """How many are raised; None where that is not known."""


def announce(central: Central, state: Path, facts: SiteFacts) -> int:
    """Enter a site, or say that it is still there; give its number.

    Raises StoreError if another pier has the name, CentralAwayError.
    """
    with open_arrivals(state, as_stored=True) as arrivals:
        query = "SELECT value FROM mark WHERE name = ?"
        identity = str(value(arrivals.connection, query, Mark.IDENTITY.value))
    latitude_deg, longitude_deg = facts.position_deg or (None, None)
    said = {
        "revision": REVISIONS[-1],
        "version": VERSION,
        "period_s": facts.period_s,
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "config": facts.config,
        "heard_utc": func.now(),
    }
    with central.transaction() as connection:
        row = insert(SITE).values(name=facts.name, identity=identity, **said)
        row = row.on_conflict_do_update(
            index_elements=["name"], set_=said, where=SITE.c.identity == identity
        )
        number = connection.scalar(row.returning(SITE.c.id))
        if number is None:
            msg = (
                f"{central.name}: the name {facts.name!r} is another database's, or this one was "
                "replaced by an empty one: give this site another [site] name; both records stay"
            )
            raise StoreError(msg)
    return int(number)


def put_rows(central: Central, state: Path, site_id: int, limit: int = BATCH) -> int:
    """Copy the next rows in one transaction; give how many, 0 at the end.

    Raises StoreError, DatabaseDamagedError of the pier's own, CentralAwayError.
    """
    with central.transaction() as connection:
        progress = Progress()
        columns = select(SITE.c.progress, SITE.c.last_slot_utc, SITE.c.late)
        site = connection.execute(
            columns.where(SITE.c.id == site_id).with_for_update(key_share=True)
        ).one()
        with open_arrivals(state, as_stored=True) as arrivals:
            if site.progress is None:
                progress.start(arrivals, history=True)
            else:
                progress.take(site.progress)
            rows = progress.pending(arrivals, limit)
        # The pier's database is closed: a server that takes its time keeps nothing of it.
        if rows:
            months = write_rows(connection, site_id, [dict(row.values) for row in rows])
            progress.note(rows)
            late = _late(site.late, months, site.last_slot_utc)
            _keep_progress(connection, site_id, rows, progress, late)
    return len(rows)


def write_rows(connection: Connection, site_id: int, rows: Sequence[dict[str, Any]]) -> set[str]:
    """Insert rows as SQLite holds them, give the months that may have changed, `2026-03`.

    Rows that are there already change nothing.
    """
    months = {row["slot_utc"][:7] for row in rows}
    make_months(connection, months)
    whole = [from_sqlite(MEASUREMENT, row, site_id) for row in rows]
    plain = [row for row in whole if row["redated_from_utc"] is None]
    moved = [row for row in whole if row["redated_from_utc"] is not None]
    if moved:
        months |= _move(connection, site_id, moved)
    if plain:
        row = insert(MEASUREMENT).on_conflict_do_nothing()
        connection.execute(row, plain)
    return months


def make_months(connection: Connection, months: set[str]) -> None:
    """Have a part for the rows of each month, `2026-03`."""
    for month in sorted(months):
        part = f"measurement_{month.replace('-', '_')}"
        if connection.scalar(text("SELECT to_regclass(:part)"), {"part": part}) is None:
            slot = {"slot": f"{month}-01T00:00:00Z"}
            connection.execute(text("SELECT dcam_month(CAST(:slot AS timestamptz))"), slot)


def _move(connection: Connection, site_id: int, rows: Sequence[dict[str, Any]]) -> set[str]:
    """Put rows whose time was put right under their true slots, and take their old ones out.

    Give the months of those.
    """
    table = MEASUREMENT.c
    # Its id is another one since it was measured again; the slot that it had first stays.
    taken = [(row["boot_id"], row["uptime_s"], row["redated_from_utc"]) for row in rows]
    first = func.coalesce(table.redated_from_utc, table.slot_utc)
    gone = connection.scalars(
        delete(MEASUREMENT)
        .where(table.site_id == site_id, tuple_(table.boot_id, table.uptime_s, first).in_(taken))
        .returning(table.slot_utc)
    ).all()
    row = insert(MEASUREMENT)
    values = {name: row.excluded[name] for name in table.keys() if name != "site_id"}  # noqa: SIM118 - no mapping
    # Another's old slot may be this one's true slot: that row is on its way to its own.
    row = row.on_conflict_do_update(index_elements=["site_id", "slot_utc"], set_=values)
    connection.execute(row, rows)
    connection.execute(
        update(SITE)
        .where(SITE.c.id == site_id)
        .values(rewritten=SITE.c.rewritten + max(len(gone), 1))
    )
    return {f"{slot_utc:%Y-%m}" for slot_utc in gone}


def _late(late: dict[str, int], months: set[str], last_slot_utc: datetime | None) -> dict[str, int]:
    """What `site.late` becomes where rows of these months came."""
    newest = "" if last_slot_utc is None else f"{last_slot_utc:%Y-%m}"
    return late | {month: late.get(month, 0) + 1 for month in months if month < newest}


def _keep_progress(
    connection: Connection,
    site_id: int,
    rows: Sequence[Arrival],
    progress: Progress,
    late: dict[str, int],
) -> None:
    last = max(row.slot for row in rows)
    values = from_sqlite(MEASUREMENT, {"slot_utc": last}, site_id)
    connection.execute(
        update(SITE)
        .where(SITE.c.id == site_id)
        .values(
            progress=progress.content(),
            late=late,
            last_slot_utc=func.greatest(SITE.c.last_slot_utc, values["slot_utc"]),
            heard_utc=func.now(),
        )
    )


def put_events(central: Central, state: Path, site_id: int, limit: int = BATCH) -> int:
    """Copy the next events in one transaction; give how many. Raises as `put_rows`."""
    with central.transaction() as connection:
        last = connection.scalar(
            select(SITE.c.event_id).where(SITE.c.id == site_id).with_for_update(key_share=True)
        )
        with open_arrivals(state) as arrivals:
            newest = int(value(arrivals.connection, "SELECT max(id) FROM event") or 0)
            if newest < int(last or 0):  # the pier's database is an earlier copy of itself
                last = 0
            query = "SELECT * FROM event WHERE id > ? ORDER BY id LIMIT ?"
            rows = proved_rows(arrivals.connection, "event", query, last or 0, limit)
        if rows:
            whole = [from_sqlite(EVENT, row, site_id) for row in rows]
            connection.execute(insert(EVENT).on_conflict_do_nothing(), whole)
            connection.execute(
                update(SITE).where(SITE.c.id == site_id).values(event_id=rows[-1]["id"])
            )
    return len(rows)


def mirror(central: Central, state: Path, site_id: int) -> int:
    """Copy what differs of the small tables in one transaction; give how many rows differed.

    Raises as `put_rows`; StoreError where a calibration is another one than that of before.
    """
    changed = 0
    with central.transaction() as connection:
        small: dict[str, Any] = connection.execute(
            select(SITE.c.small).where(SITE.c.id == site_id).with_for_update(key_share=True)
        ).scalar_one()
        with open_arrivals(state) as arrivals:
            sums = {table.name: _sum(arrivals.connection, table) for table in MIRRORED}
        for table in MIRRORED:
            if sums[table.name] != small.get(table.name):
                changed += _mirror(connection, state, table, site_id, central.name)
        if sums == small:
            return 0
        connection.execute(
            update(SITE).where(SITE.c.id == site_id).values(small=sums, heard_utc=func.now())
        )
    return changed


def _sum(connection: sqlite3.Connection, table: Table) -> list[int]:
    """How many rows a table has, and a checksum of them."""
    query = f"SELECT count(*), coalesce(sum(digest & {DIGEST_PART}), 0) FROM {table.name}"  # noqa: S608 - our own names
    return list(fetch(connection, query)[0])


def _mirror(connection: Connection, state: Path, table: Table, site_id: int, name: str) -> int:
    """Copy what differs of one table. What changes meanwhile on the pier is copied next time."""
    key = key_of(table)
    query = f"SELECT {key}, digest FROM {table.name}"  # noqa: S608 - our own names
    with open_arrivals(state) as arrivals:
        here = dict(fetch(arrivals.connection, query))
    mine = table.c.site_id == site_id
    found = connection.execute(select(table.c[key], table.c.digest).where(mine))
    there: Mapping[Any, int] = {row[0]: row[1] for row in found}
    differing = {known for known in there if here.get(known) != there[known]}
    if table.name in CHANGING:
        if differing:
            connection.execute(delete(table).where(mine, table.c[key].in_(differing)))
    elif replaced := sorted(known for known in differing if known in here):
        msg = (
            f"{name}: {table.name} {replaced[0]} of this site is another one there: an earlier "
            "copy of the pier's database was put back and went its own way; give the site "
            "another [site] name, so that both records stay"
        )
        raise StoreError(msg)
    missing = [known for known in here if here[known] != there.get(known)]
    query = f"SELECT * FROM {table.name} WHERE {key} = ?"  # noqa: S608 - our own names
    with open_arrivals(state) as arrivals:
        rows = [
            row
            for known in missing
            for row in proved_rows(arrivals.connection, table.name, query, known)
        ]
    if rows:
        connection.execute(insert(table), [from_sqlite(table, row, site_id) for row in rows])
    return len(rows)


def put_status(central: Central, site_id: int, said: Verdict, status: Mapping[str, Any]) -> None:
    """Keep what the pier says of itself. Raises CentralAwayError."""
    with central.transaction() as connection:
        connection.execute(
            update(SITE)
            .where(SITE.c.id == site_id)
            .values(**asdict(said), status=dict(status), heard_utc=func.now())
        )
