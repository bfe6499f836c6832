"""Closed months of all sites as Parquet at any URL, each written once and replaced as a whole.

`measurement/site=NAME/year=YYYY/month=MM/rows.parquet`, and `datum`, `gap` and `ledger` of each
site beside it. What was written of a site stands in `written/NAME.json`, put there last: whatever
is cut off is written again, to the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from daemon.durable import make_directory_durable, write_durable
from daemon.fleet.month_file import LAYOUT, parquet_of_rows, parquet_of_small
from daemon.remote_path import RemotePath, is_url

if TYPE_CHECKING:
    from daemon.store.central.connecting import Central
    from daemon.store.central.months import SiteMonth

Place = Path | RemotePath
Written = dict[str, Any]
"""Of a site: what each of its files was made from, by the file's path."""


@dataclass(slots=True)
class Archived:
    """What one run wrote."""

    months: int = 0
    rows: int = 0
    size: int = 0
    """Bytes of the months."""
    kept: int = 0
    """Months that were there already."""
    fewer: list[str] = field(default_factory=list)
    """Months that now have fewer rows than were written: their files stay."""
    small: int = 0
    """Tables of datums, gaps and ledgers that were new or had changed."""


def write_archive(
    central: Central,
    place: str,
    since: datetime,
    tell: Callable[[int, int | None], None] = lambda _done, _total: None,
) -> Archived:
    """Write what is closed and not there yet.

    Raises CentralAwayError, HardwareError, UsageError, WorkFailedError, OSError.
    """
    from daemon.store.central.months import closed_months

    root: Place = RemotePath(place) if is_url(place) else Path(place).absolute()
    done = Archived()
    for name, months in groupby(closed_months(central, since), lambda month: month.site):
        noted = root / "written" / f"{quote(name, safe='')}.json"
        written = _read(noted)
        before = json.dumps(written)
        for month in months:
            _write_month(central, root, month, written, done)
            tell(done.rows, None)
            site_id = month.site_id
        _write_small(central, root, name, site_id, written, done)
        if json.dumps(written) != before:
            _write(noted, json.dumps(written, indent=1).encode())
    return done


def _write_month(
    central: Central, root: Place, month: SiteMonth, written: Written, done: Archived
) -> None:
    from daemon.store.central.months import month_rows

    part = f"measurement/site={quote(month.site, safe='')}/{month.begin_utc:year=%Y/month=%m}"
    made_from = [LAYOUT, month.rows, month.digest]
    if written.get(part) == made_from:
        done.kept += 1
        return
    if month.rows < written.get(part, made_from)[1]:  # a month that was taken out, with a late row
        done.fewer.append(part)
        return
    content = parquet_of_rows(month_rows(central, month), month.site)
    _write(root / part / "rows.parquet", content)
    written[part] = made_from
    done.months += 1
    done.rows += month.rows
    done.size += len(content)


def _write_small(
    central: Central, root: Place, name: str, site_id: int, written: Written, done: Archived
) -> None:
    from daemon.store.central.months import small_rows
    from daemon.store.central.tables import DATUM, GAP, LEDGER

    for table in (DATUM, GAP, LEDGER):
        rows = small_rows(central, table, site_id)
        part = f"{table.name}/site={quote(name, safe='')}"
        made_from = [LAYOUT, sum(row["digest"] for row in rows), len(rows)]
        if not rows or written.get(part) == made_from:
            continue
        _write(root / part / f"{table.name}.parquet", parquet_of_small(rows))
        written[part] = made_from
        done.small += 1


def _read(place: Place) -> Written:
    try:
        found: Written = json.loads(place.read_bytes())
    except FileNotFoundError:
        return {}
    return found


def _write(place: Place, content: bytes) -> None:
    """Either the old file (or none) or the new one is there at any moment."""
    if isinstance(place, RemotePath):
        place.write_bytes(content)
        return
    make_directory_durable(place.parent)
    write_durable(place, content)
