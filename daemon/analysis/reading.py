"""The front door: a stretch of a store analysed, for command, page and client's report."""

from __future__ import annotations

from datetime import datetime

from daemon.analysis.record import RecordReader
from daemon.analysis.study import Asked, Study, study
from daemon.store.database import Store
from daemon.store.queries.columns import Tell
from daemon.store.recorded_span import recorded_span


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
    span = recorded_span(store, since, until)
    reader = RecordReader(
        store.path,
        *span,
        point=asked.point,
        readings=asked.readings,
        with_excluded=asked.with_excluded,
    )
    return study(reader.read(tell), asked, span, period_s)
