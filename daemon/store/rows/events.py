"""What happened to the system, and the few single values that survive a restart."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from daemon.store.records import EventRecord, Mark
from daemon.store.schema import EventRow, MarkRow


def add(session: Session, time_utc: datetime, kind: str, detail: str) -> None:
    """Write one line of the system's history."""
    session.add(EventRow(time_utc=time_utc, kind=kind, detail=detail))


def find(session: Session, since: datetime, until: datetime, kind: str | None) -> list[EventRecord]:
    """Events with since <= time < until, of one kind if given, in order."""
    column = EventRow.time_utc
    query = select(EventRow).where(column >= since, column < until)
    if kind is not None:
        query = query.where(EventRow.kind == kind)
    rows = session.scalars(query.order_by(column, EventRow.id))
    return [EventRecord(row.time_utc, row.kind, row.detail) for row in rows]


def set_marks(session: Session, marks: Mapping[Mark, str | None]) -> None:
    """Set marks, or remove those that are None."""
    for mark, value in marks.items():
        row = session.get(MarkRow, mark.value)
        if value is not None:
            session.merge(MarkRow(name=mark.value, value=value))
        elif row is not None:
            session.delete(row)
