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
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from daemon.durable import make_directory_durable, write_durable
from daemon.fleet.month_file import LAYOUT, parquet_of_rows, parquet_of_small
from daemon.remote_path import RemotePath, is_url

if TYPE_CHECKING:
    from daemon.store.central.connecting import Central
    from daemon.store.central.months import LeavingSite, LeftMonth

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
    from daemon.store.central.months import leaving_sites

    root: Place = RemotePath(place) if is_url(place) else Path(place).absolute()
    done = Archived()
    for site in leaving_sites(central, since):
        if not site.months:
            continue
        noted = root / "written" / f"{quote(site.name, safe='')}.json"
        written = _read(noted)
        before = json.dumps(written)
        for month in site.months:
            _write_month(central, root, site, month, written, done)
            tell(done.rows, None)
        if any(written[_part(site, month)][1] for month in site.months):
            _write_small(central, root, site, written, done)
        if json.dumps(written) != before:
            _write(noted, json.dumps(written, indent=1).encode())
    return done


def _part(site: LeavingSite, month: LeftMonth) -> str:
    return f"measurement/site={quote(site.name, safe='')}/{month.begin_utc:year=%Y/month=%m}"


def _write_month(
    central: Central,
    root: Place,
    site: LeavingSite,
    month: LeftMonth,
    written: Written,
    done: Archived,
) -> None:
    from daemon.store.central.months import counted, month_rows

    part = _part(site, month)
    # What was written before changes were counted has three entries: it is counted once more.
    layout, rows, digest, changed = [*written.get(part, (LAYOUT, 0, 0)), None][:4]
    if (layout, changed) == (LAYOUT, month.changed):
        done.kept += rows > 0
        return
    now = counted(central, site, month)
    if now.rows < rows:  # a month that was taken out, with a late row
        done.fewer.append(part)
        return
    written[part] = [LAYOUT, now.rows, now.digest, month.changed]
    if not now.rows or (layout, rows, digest) == (LAYOUT, now.rows, now.digest):
        done.kept += now.rows > 0
        return
    content = parquet_of_rows(month_rows(central, now), site.name)
    _write(root / part / "rows.parquet", content)
    done.months += 1
    done.rows += now.rows
    done.size += len(content)


def _write_small(
    central: Central, root: Place, site: LeavingSite, written: Written, done: Archived
) -> None:
    from daemon.store.central.months import small_rows
    from daemon.store.central.tables import DATUM, GAP, LEDGER

    for table in (DATUM, GAP, LEDGER):
        rows = small_rows(central, table, site.id)
        part = f"{table.name}/site={quote(site.name, safe='')}"
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
