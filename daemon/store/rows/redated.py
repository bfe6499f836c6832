"""What a wrong clock had dated, as it was measured then; and what came of measuring it again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from daemon.store.integrity.digest import stored_values
from daemon.store.records import Again, RedatedRecord
from daemon.store.rows.convert import measurement_record
from daemon.store.schema import MeasurementRow, RedatedRow


def keep_row(
    session: Session, row: MeasurementRow, slot_utc: datetime | None, unseen: int = 0
) -> None:
    """Keep a row that leaves its slot, for another one or for none, as it is.

    Up to `unseen` rows that are written later may have been held against it as well.
    """
    newest_id = session.scalar(select(func.max(MeasurementRow.id))) or 0
    for entry in _waiting(session, row.slot_utc):  # it went on before it was measured again
        entry.again = Again.MOVED
    session.add(
        RedatedRow(
            slot_utc=slot_utc,
            from_slot_utc=row.slot_utc,
            content=json.dumps(stored_values(row), allow_nan=False, separators=(",", ":")),
            row_id=row.id,
            newest_id=newest_id + unseen,
            again=Again.MOVED if slot_utc is None else None,
        )
    )


def keep_undated(
    session: Session, content: str, from_slot_utc: datetime, slot_utc: datetime
) -> None:
    """Keep an undated pair that gets its slot, as it was measured."""
    session.add(RedatedRow(slot_utc=slot_utc, from_slot_utc=from_slot_utc, content=content))


def next_waiting(session: Session) -> tuple[int, datetime] | None:
    """The number and the slot of the earliest that waits to be measured again."""
    query = select(RedatedRow).where(RedatedRow.again.is_(None)).order_by(RedatedRow.slot_utc)
    row = session.scalar(query.limit(1))
    return None if row is None or row.slot_utc is None else (row.id, row.slot_utc)


def finish(session: Session, number: int, again: Again) -> None:
    """Say what came of measuring one again."""
    row = session.get_one(RedatedRow, number)
    row.again = again


def find_all(session: Session) -> list[RedatedRecord]:
    """All of them, in the order in which they were dated."""
    none = dict.fromkeys(column.name for column in MeasurementRow.__table__.columns)
    return [
        RedatedRecord(
            slot_utc=row.slot_utc,
            before=measurement_record(none | json.loads(row.content)),
            again=None if row.again is None else Again(row.again),
            seen_by=range((row.row_id or 0) + 1, (row.newest_id or 0) + 1),
        )
        for row in session.scalars(select(RedatedRow).order_by(RedatedRow.id))
    ]


def _waiting(session: Session, slot_utc: datetime) -> Sequence[RedatedRow]:
    query = select(RedatedRow).where(RedatedRow.again.is_(None), RedatedRow.slot_utc == slot_utc)
    return session.scalars(query).all()
