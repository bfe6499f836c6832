"""Many rows at once, for records of hours and days."""

from __future__ import annotations

from collections.abc import Iterable

from daemon.store.database import Store
from daemon.store.records import MeasurementRecord
from daemon.store.rows.convert import measurement_columns
from daemon.store.schema import MeasurementRow


def add_rows(store: Store, records: Iterable[MeasurementRecord]) -> None:
    """Write rows as `add_measurement` does one by one, in a tenth of the time: as one transaction.

    Their slots are free and in no gap.
    """
    with store._write() as session:
        session.add_all([MeasurementRow(**measurement_columns(record)) for record in records])
