"""The rows of the central database by site and month: which months are closed, and their rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Interval, Table, cast, func, select

from daemon.store.central.connecting import Central
from daemon.store.central.tables import DIGEST_PART, MEASUREMENT, SITE, to_sqlite
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


def closed_months(central: Central, since: datetime) -> Iterator[SiteMonth]:
    """Months from one on that a site has left behind, by site and month.

    Rows are copied in the order in which they were written: with a row of a later month all of
    this one are there, and what no row says of it is a gap that has ended. Raises CentralAwayError.
    """
    begin = func.date_trunc("month", MEASUREMENT.c.slot_utc, "UTC").label("begin_utc")
    end = begin + cast("1 month", Interval)
    sums = (
        select(
            *(MEASUREMENT.c.site_id, begin, end.label("end_utc"), func.count().label("rows")),
            func.sum(MEASUREMENT.c.digest.op("&")(DIGEST_PART)).label("digest"),
        )
        .where(MEASUREMENT.c.slot_utc >= since)
        .group_by(MEASUREMENT.c.site_id, begin)
        .subquery()
    )
    query = (
        select(sums, SITE.c.name)
        .join(SITE, SITE.c.id == sums.c.site_id)
        .where(SITE.c.last_slot_utc >= sums.c.end_utc)
        .order_by(SITE.c.name, sums.c.begin_utc)
    )
    with central.transaction() as connection:
        found = connection.execute(query).all()
    for row in found:
        sum_of = int(row.digest or 0)
        yield SiteMonth(row.site_id, row.name, row.begin_utc, row.end_utc, row.rows, sum_of)


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
