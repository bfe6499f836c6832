"""The front door: a stretch of a store analysed, for command, page and client's report."""

from __future__ import annotations

from datetime import datetime, timedelta

from daemon.analysis.record import read_record
from daemon.analysis.study import Asked, Study, study
from daemon.errors import WorkFailedError
from daemon.store.columns import Tell
from daemon.store.database import Store
from daemon.text import utc_text


def analyse_store(
    store: Store,
    since: datetime | None,
    until: datetime | None,
    asked: Asked,
    period_s: float,
    tell: Tell = lambda _done, _total: None,
) -> Study:
    """Analyse one axis of one point; some seconds for a year, so not in a server's own loop.

    Raises UsageError for unknown names, WorkFailedError without a row, StoreError.
    """
    span = _span(store, since, until)
    record = read_record(
        store.path,
        *span,
        point=asked.point,
        readings=asked.readings,
        with_excluded=asked.with_excluded,
        tell=tell,
    )
    return study(record, asked, span, period_s)


def _span(
    store: Store, since: datetime | None, until: datetime | None
) -> tuple[datetime, datetime]:
    accounted = store.accounted()
    if accounted is None:
        msg = f"{store.path}: holds no slot yet; start dcamd, or name another --state"
        raise WorkFailedError(msg)
    first, end = accounted[0], accounted[1] + timedelta(seconds=1)
    begin_utc, end_utc = max(since or first, first), min(until or end, end)
    if begin_utc >= end_utc:
        known = f"{utc_text(first)} to {utc_text(accounted[1])}"
        msg = f"{store.path}: no slots in this span; there are slots from {known}"
        raise WorkFailedError(msg)
    return begin_utc, end_utc
