"""Pairs measured while the clock was wrong: kept whole, until their slots are known."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from daemon.errors import StoreError
from daemon.store.records import MeasurementRecord
from daemon.store.rows.convert import measurement_columns, measurement_record
from daemon.store.rows.redated import keep_undated
from daemon.store.schema import MeasurementRow, UndatedRow
from daemon.times import instant_text


def add(session: Session, path: Path, record: MeasurementRecord) -> None:
    """Keep a pair. Raises StoreError for one that is not finite, or does not know its boot."""
    try:
        session.add(_row(record))
    except ValueError as error:
        msg = f"{path}: what was taken at {record.captured_utc} cannot be kept: {error}"
        raise StoreError(msg) from error


def _row(record: MeasurementRecord) -> UndatedRow:
    if record.boot_id is None or record.uptime_s is None or record.captured_utc is None:
        msg = "a pair without its time since the boot could never be dated"
        raise ValueError(msg)
    columns = {name: _plain(value) for name, value in measurement_columns(record).items()}
    return UndatedRow(
        boot_id=record.boot_id,
        uptime_s=record.uptime_s,
        clock_utc=record.captured_utc,
        content=json.dumps(columns, allow_nan=False, separators=(",", ":")),
    )


def undated_records(session: Session, boot_id: str | None) -> list[tuple[int, MeasurementRecord]]:
    """Ids and records, of one boot if given, in the order in which they were taken."""
    query = select(UndatedRow).order_by(UndatedRow.id)
    if boot_id is not None:
        query = query.where(UndatedRow.boot_id == boot_id)
    return [(row.id, _record(row)) for row in session.scalars(query)]


def date(session: Session, undated_id: int, record: MeasurementRecord) -> None:
    """Take one out, in the transaction that gives it its slot; what it was is kept."""
    row = session.get_one(UndatedRow, undated_id)
    keep_undated(session, row.content, _record(row).slot_utc, record.slot_utc)
    session.delete(row)


def _record(row: UndatedRow) -> MeasurementRecord:
    none = dict.fromkeys(column.name for column in MeasurementRow.__table__.columns)
    return measurement_record(none | json.loads(row.content))


def _plain(value: object) -> object:
    return instant_text(value) if isinstance(value, datetime) else value
