"""A stretch of the record as a figure shows it: rows, few enough to be drawn, and gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import islice

from daemon.errors import WorkFailedError
from daemon.reports.figure import GapSpan, Series, series_of
from daemon.store.database import Store
from daemon.store.records import Coverage, GapRecord
from daemon.text import utc_text

MOST_POINTS = 20_000
"""More than this a figure cannot show and a reader cannot tell apart."""


@dataclass(frozen=True, slots=True)
class History:
    """A stretch of the record."""

    since_utc: datetime
    until_utc: datetime
    """The first slot after it."""
    coverage: Coverage
    gaps: tuple[GapRecord, ...]
    series: Series
    every: int
    """Each so-manieth row is in the series; 1: all are."""


def read_history(
    store: Store, since: datetime | None, until: datetime | None, *, period_s: int, offset_s: int
) -> History:
    """Read what there is from `since` to `until`. Raises StoreError, WorkFailedError if nothing."""
    accounted = store.accounted()
    if accounted is None:
        msg = f"{store.path}: holds no slot yet; start dcamd, or name another --state"
        raise WorkFailedError(msg)
    first_utc = max(since or accounted[0], accounted[0])
    end_utc = min(until or accounted[1] + timedelta(seconds=1), accounted[1] + timedelta(seconds=1))
    if first_utc >= end_utc:
        known = f"{utc_text(accounted[0])} to {utc_text(accounted[1])}"
        msg = f"{store.path}: no slots in this span; there are slots from {known}"
        raise WorkFailedError(msg)
    coverage = store.coverage(first_utc, end_utc, period_s=period_s, offset_s=offset_s)
    every = max(1, -(-coverage.measured // MOST_POINTS))
    rows = islice(store.measurements(first_utc, end_utc), None, None, every)
    return History(
        since_utc=first_utc,
        until_utc=end_utc,
        coverage=coverage,
        gaps=tuple(store.gaps(first_utc, end_utc)),
        series=series_of([(row.slot_utc, row.measurement) for row in rows]),
        every=every,
    )


def gap_spans(gaps: Sequence[GapRecord]) -> list[GapSpan]:
    """Gaps as a figure shows them: from half a period before the first slot to half after."""
    half = [timedelta(seconds=gap.period_s / 2) for gap in gaps]
    return [
        GapSpan(gap.first_slot_utc - wide, gap.last_slot_utc + wide, gap.cause.value)
        for gap, wide in zip(gaps, half, strict=True)
    ]
