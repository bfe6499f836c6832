"""The report of each finished month, written once into the state directory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

from daemon.config.reading import Installation
from daemon.config.report import DIRECTORY
from daemon.durable import write_durable
from daemon.errors import DatabaseMissingError, HardwareError, WorkFailedError
from daemon.reports.page import ReportPlan, make_report, write_html
from daemon.reports.pdf import write_pdf
from daemon.reports.statement import TRIALS
from daemon.status.coverage import coverage_text
from daemon.store.database import Store, open_store_readonly

_OURS = re.compile(r"(?P<month>\d{4}-\d{2})\.(html|pdf)")


def last_month(now: datetime, zone: tzinfo) -> tuple[datetime, datetime]:
    """Begin and end of the last finished month by the clock of a zone, in UTC."""
    local = now.astimezone(zone)
    end = datetime(local.year, local.month, 1, tzinfo=zone)
    before = end - timedelta(days=1)
    begin = datetime(before.year, before.month, 1, tzinfo=zone)
    return begin.astimezone(UTC), end.astimezone(UTC)


def write_last_month(
    site: Installation,
    zone: tzinfo,
    reference: Path | None = None,
    trials: int | None = None,
    now: datetime | None = None,
) -> Iterator[str]:
    """Write the last month's report unless it is there, and remove those that are too old.

    Gives a line for each thing done. A month without slots has none. Raises StoreError, OSError,
    HardwareError, WorkFailedError.
    """
    since, until = last_month(now or datetime.now(UTC), zone)
    name = f"{since.astimezone(zone):%Y-%m}"
    directory = site.state_directory / DIRECTORY
    page, printed = directory / f"{name}.html", directory / f"{name}.pdf"
    if page.exists() and printed.exists():
        yield f"{name} is written: {page}, {printed}"
        return
    try:
        store = open_store_readonly(site.state_directory)
    except DatabaseMissingError:
        yield f"{name}: nothing is recorded yet, so there is no report"
        return
    with store:
        if not _has_slots(store, since, until):
            yield f"{name} has no slots, so there is no report of it"
            return
        plan = ReportPlan(
            since,
            until,
            zone,
            reference or site.config.report.reference,
            trials=TRIALS if trials is None else trials,
        )
        try:
            report = make_report(site, store, plan)
        except (HardwareError, WorkFailedError) as error:
            if plan.reference is None:
                raise
            yield f"{name} is written without a comparison: {error}"
            report = make_report(site, store, replace(plan, reference=None))
    directory.mkdir(mode=0o750, exist_ok=True)
    write_durable(printed, write_pdf(report.document))
    write_durable(page, write_html(report.document).encode())
    yield f"{page}, {printed}: {coverage_text(report.history.coverage)}"
    yield from _remove_old(directory, site.config.report.months_kept)


def _has_slots(store: Store, since: datetime, until: datetime) -> bool:
    accounted = store.accounted()
    return accounted is not None and accounted[0] < until and accounted[1] >= since


def _remove_old(directory: Path, months_kept: int) -> Iterator[str]:
    """Remove our files of all but the newest months."""
    ours = {
        path: found["month"]
        for path in directory.iterdir()
        if (found := _OURS.fullmatch(path.name))
    }
    for month in sorted(set(ours.values()), reverse=True)[months_kept:]:
        for path in sorted(path for path, one in ours.items() if one == month):
            path.unlink()
            yield f"{path}: removed, [report] months_kept = {months_kept}"
