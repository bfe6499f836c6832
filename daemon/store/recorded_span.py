"""The part of a wanted span that the record has anything of."""

from __future__ import annotations

from datetime import datetime, timedelta

from daemon.errors import WorkFailedError
from daemon.store.database import Store
from daemon.text import utc_text


def recorded_span(
    store: Store, since: datetime | None, until: datetime | None
) -> tuple[datetime, datetime]:
    """Give since <= slot < until within the slots that are accounted for.

    Raises WorkFailedError where there are none, StoreError.
    """
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
