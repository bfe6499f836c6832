"""What a wrong clock leaves in a database: undated pairs, rows dated again and measured again."""

from __future__ import annotations

from datetime import datetime

from daemon.store.records import Again, MeasurementRecord, RedatedRecord
from daemon.store.rows import measurements, redated, undated
from daemon.store.transactions import Transactions


class WrongClock(Transactions):
    """The part of `Store` that puts times right."""

    def add_undated(self, record: MeasurementRecord) -> None:
        """Keep a pair that was taken while the clock was before the last slot.

        Raises StoreError for a measurement that is not finite, or that does not know its boot.
        """
        with self._write() as session:
            undated.add(session, self.path, record)

    def undate(self, record: MeasurementRecord, unseen: int = 0) -> None:
        """Turn a row into an undated pair, as the record says: its time is known to be wrong.

        unseen: see `move_row`.
        """
        with self._write() as session:
            measurements.remove(session, record.slot_utc, unseen)
            undated.add(session, self.path, record)

    def undated(self, boot_id: str | None = None) -> list[tuple[int, MeasurementRecord]]:
        """What waits for its slot, of one boot if given: ids and records as taken, in order."""
        with self._session() as session:
            return undated.undated_records(session, boot_id)

    def date(self, undated_id: int, record: MeasurementRecord) -> None:
        """Write the row of an undated pair whose slot is known now; it waits to be measured again.

        Raises as add_measurement.
        """
        with self._write() as session:
            measurements.add(session, self.path, record)
            undated.date(session, undated_id, record)

    def move_row(self, from_slot_utc: datetime, record: MeasurementRecord, unseen: int = 0) -> None:
        """Give a row that a wrong clock had dated its true slot; it waits to be measured again.

        Up to `unseen` rows that are written later may have been held against it as it was. Raises
        SlotTakenError, and StoreError when no row is there.
        """
        with self._write() as session:
            measurements.move(session, self.path, from_slot_utc, record, unseen)

    def next_to_measure_again(self) -> tuple[int, datetime] | None:
        """The number and the slot of the earliest row that waits, of those dated again."""
        with self._session() as session:
            return redated.next_waiting(session)

    def measured_again(self, number: int, record: MeasurementRecord) -> None:
        """Put a row that was measured again in the place of that of its slot.

        It is written last, as any new row; what it replaces is kept. Raises ValueError for a
        measurement that is not finite.
        """
        with self._write() as session:
            measurements.replace(session, record)
            redated.finish(session, number, Again.MEASURED)

    def not_measured_again(self, number: int, why: Again) -> None:
        """Leave a row as it was measured under a wrong clock."""
        with self._write() as session:
            redated.finish(session, number, why)

    def redated(self) -> list[RedatedRecord]:
        """All that was dated again, as it was before, in the order in which that was done."""
        with self._session() as session:
            return redated.find_all(session)

    def last_slot_but(self, boot_id: str) -> datetime | None:
        """The latest slot with a row, but for what a boot took under an undisciplined clock."""
        with self._read() as connection:
            return measurements.last_slot_but(connection, boot_id)

    def unsynchronised_rows(self, boot_id: str) -> list[MeasurementRecord]:
        """The rows that a boot took while nothing disciplined the clock, in order."""
        with self._read() as connection:
            return measurements.unsynchronised(connection, boot_id)

    def moved_from(self, since: datetime) -> set[datetime]:
        """Slots, from `since` on, whose row went elsewhere: their frames belong to that."""
        with self._read() as connection:
            return measurements.moved_from(connection, since)
