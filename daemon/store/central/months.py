"""The rows of the central database by site and month: which months are closed, and their rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import Table, func, select, text

from daemon.store.central.connecting import Central
from daemon.store.central.site_table import SITE
from daemon.store.central.tables import DIGEST_PART, MEASUREMENT, to_sqlite
from daemon.store.queries.columns import BATCH, Columns


@dataclass(frozen=True, slots=True)
class SiteMonth:
    """A site's rows of one month, UTC."""

    site_id: int
    site: str
    begin_utc: datetime
    end_utc: datetime
    rows: int
    digest: int
    """A sum over the rows' checksums: another one if any row came, went or changed."""


@dataclass(frozen=True, slots=True)
class LeftMonth:
    """A month that a site has left behind, its rows not looked at."""

    begin_utc: datetime
    end_utc: datetime
    changed: int
    """How often it changed after that: another number wherever its rows may differ."""


@dataclass(frozen=True, slots=True)
class LeavingSite:
    """A site and the months that it has left behind."""

    id: int
    name: str
    months: tuple[LeftMonth, ...]


def leaving_sites(central: Central, since: datetime) -> list[LeavingSite]:
    """Sites by name, with the months from one on that they have left and of which rows are there.

    Rows are copied in the order in which they were written: with a row of a later month all of
    this one are there, and what no row says of it is a gap that has ended. Raises CentralAwayError.
    """
    columns = SITE.c
    query = select(columns.id, columns.name, columns.last_slot_utc, columns.late)
    with central.transaction() as connection:
        parts = connection.scalars(text(_PARTS)).all()
        sites = connection.execute(query.order_by(columns.name)).all()
    begins = [datetime.strptime(part, "measurement_%Y_%m").replace(tzinfo=UTC) for part in parts]
    spans = [(begin, _month_after(begin)) for begin in begins]
    return [
        LeavingSite(
            site.id,
            site.name,
            tuple(
                LeftMonth(begin, end, site.late.get(f"{begin:%Y-%m}", 0))
                for begin, end in spans
                if end > since and site.last_slot_utc is not None and site.last_slot_utc >= end
            ),
        )
        for site in sites
    ]


_PARTS = """
SELECT relname FROM pg_inherits JOIN pg_class ON pg_class.oid = inhrelid
WHERE inhparent = 'measurement'::regclass ORDER BY relname
"""


def _month_after(begin: datetime) -> datetime:
    return (begin + timedelta(days=32)).replace(day=1)


def counted(central: Central, site: LeavingSite, month: LeftMonth) -> SiteMonth:
    """Count a month's rows, and add up their checksums. Raises CentralAwayError."""
    table = MEASUREMENT.c
    query = (
        select(func.count(), func.sum(table.digest.op("&")(DIGEST_PART)))
        .where(table.site_id == site.id)
        .where(table.slot_utc >= month.begin_utc, table.slot_utc < month.end_utc)
    )
    with central.transaction() as connection:
        rows, digest = connection.execute(query).one()
    return SiteMonth(site.id, site.name, month.begin_utc, month.end_utc, rows, int(digest or 0))


def month_rows(central: Central, month: SiteMonth) -> Iterator[Columns]:
    """A month's rows by slot, many at a time, as the site's SQLite holds them.

    Raises CentralAwayError.
    """
    table = MEASUREMENT.c
    query = (
        select(MEASUREMENT)
        .where(table.site_id == month.site_id)
        .where(table.slot_utc >= month.begin_utc, table.slot_utc < month.end_utc)
        .order_by(table.slot_utc)
    )
    with central.transaction() as connection:
        rows = connection.execution_options(yield_per=BATCH).execute(query).mappings()
        for part in rows.partitions():
            found = [to_sqlite(MEASUREMENT, dict(row)) for row in part]
            yield Columns({name: [row[name] for row in found] for name in found[0]})


def small_rows(central: Central, table: Table, site_id: int) -> list[dict[str, Any]]:
    """All rows of one of a site's small tables, as its SQLite holds them.

    Raises CentralAwayError.
    """
    query = select(table).where(table.c.site_id == site_id).order_by(table.c.id)
    with central.transaction() as connection:
        found = connection.execute(query).mappings().all()
    return [to_sqlite(table, dict(row)) for row in found]
