"""Calibrations: stored for good, one of them in use."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from daemon.store.records import CalibrationRecord, DatumRecord
from daemon.store.rows.convert import calibration_record, calibration_row
from daemon.store.rows.datum import datum_columns
from daemon.store.schema import ActivationRow, CalibrationRow, DatumRow


def add(
    session: Session,
    record: CalibrationRecord,
    datum: DatumRecord | None = None,
    *,
    activate: bool,
) -> int:
    """Store a calibration with its datum, and make it the one in use if asked; give its id.

    Raises ValueError for content that is not plain, finite JSON.
    """
    row = calibration_row(record)
    session.add(row)
    session.flush()
    if datum is not None:
        add_datum(session, row.id, datum)
    if activate:
        session.add(ActivationRow(calibration_id=row.id, activated_utc=record.created_utc))
    return row.id


def add_datum(session: Session, calibration_id: int, record: DatumRecord) -> None:
    """Give a calibration a link that holds from now on. Raises ValueError unless it is finite."""
    session.add(DatumRow(calibration_id=calibration_id, **datum_columns(record)))
    session.flush()


def active(session: Session) -> CalibrationRecord | None:
    """The calibration in use."""
    newest = select(func.max(ActivationRow.id)).scalar_subquery()
    query = select(CalibrationRow).join(ActivationRow).where(ActivationRow.id == newest)
    row = session.scalar(query)
    return None if row is None else calibration_record(row)


def find(session: Session, calibration_id: int) -> CalibrationRecord | None:
    """One calibration."""
    row = session.get(CalibrationRow, calibration_id)
    return None if row is None else calibration_record(row)


def find_all(session: Session) -> list[CalibrationRecord]:
    """All of them, oldest first."""
    rows = session.scalars(select(CalibrationRow).order_by(CalibrationRow.id))
    return [calibration_record(row) for row in rows]
