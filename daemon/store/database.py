"""The database: every slot's row or gap, calibrations, events and marks, durable when it returns.

Each method is one transaction. What has returned is on the disk (WAL, synchronous=FULL); what
raised has changed nothing. A store may be used from several threads; readers never wait for the
writer, nor it for them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import cast

from sqlalchemy import Engine

from core.arrays import FloatArray
from daemon.durable import fsync_directory
from daemon.store.accounting import missing_slots
from daemon.store.copying import Copied, Tell, backup, rescue
from daemon.store.engine import make_engine, translated
from daemon.store.ledger import rows as ledger_rows
from daemon.store.ledger.entries import LedgerEntry
from daemon.store.migrate import migrate as run_migrations
from daemon.store.migrate import require_head
from daemon.store.preparing import path_for_writing
from daemon.store.queries.columns import read_columns
from daemon.store.queries.overview import Overview
from daemon.store.records import (
    CalibrationRecord,
    Coverage,
    DatumRecord,
    EventRecord,
    FrameDay,
    GapCause,
    GapRecord,
    Mark,
    MeasurementRecord,
    PastRows,
)
from daemon.store.rows import calibrations, datum, events, frame_days, measurements, past
from daemon.store.rows import gaps as gap_runs
from daemon.store.rows.convert import measurement_record
from daemon.store.rows.hourly_closures import hourly_closures
from daemon.store.rows.known import NEWEST
from daemon.store.runs import run_between, schedule_slots
from daemon.store.sqlite import existing_path
from daemon.store.wrong_clock import WrongClock

ALWAYS = datetime(1, 1, 1, tzinfo=UTC)
NEVER = datetime(9999, 12, 31, tzinfo=UTC)
"""The stretch [ALWAYS, NEVER) holds everything."""


def open_store(
    directory: Path,
    *,
    create: bool = True,
    migrate: bool = True,
    now_utc: datetime | None = None,
    checked: bool = False,
) -> Store:
    """Open the database of a state directory for writing; make or migrate it as allowed.

    Its newest rows are looked at, unless it was `checked`; before a migration it is saved, dated.
    Raises DatabaseMissingError, DatabaseDamagedError, DatabaseNewerError, DatabaseOlderError.
    """
    path = path_for_writing(directory, create=create, checked=checked)
    engine = make_engine(path)
    with _closed_on_error(engine):
        if migrate:
            run_migrations(engine, path, now_utc or datetime.now(UTC))
            fsync_directory(directory)
        else:
            require_head(engine, path)
    return Store(path, engine)


def open_store_readonly(directory: Path) -> Store:
    """Open the database for reading beside a running daemon, or without one.

    Raises DatabaseMissingError, DatabaseDamagedError, DatabaseNewerError, DatabaseOlderError.
    """
    path = existing_path(directory)
    engine = make_engine(path, readonly=True)
    with _closed_on_error(engine):
        require_head(engine, path)
    return Store(path, engine)


@contextmanager
def _closed_on_error(engine: Engine) -> Iterator[None]:
    try:
        yield
    except BaseException:
        engine.dispose()
        raise


class Store(WrongClock):
    """An open database; use `open_store` or `open_store_readonly`."""

    def __init__(self, path: Path, engine: Engine, before_id: int = NEWEST) -> None:
        super().__init__(path, engine)
        self._before_id = before_id

    # Measurements

    def add_measurement(self, record: MeasurementRecord) -> None:
        """Write one slot's row; a gap that holds the slot shrinks or splits around it.

        Raises SlotTakenError, and StoreError for a measurement that is not finite.
        """
        with self._write() as session:
            measurements.add(session, self.path, record)

    def measurement(self, slot_utc: datetime) -> MeasurementRecord | None:
        """The row of a slot."""
        with self._read() as connection:
            return measurements.find(connection, slot_utc)

    def row_id(self, slot_utc: datetime) -> int | None:
        """The id of a slot's row: ids grow in the order of writing."""
        with self._read() as connection:
            return measurements.row_id(connection, slot_utc)

    def as_before(self, row_id: int) -> Store:
        """The same database; as past rows it gives those that were written before a row."""
        return Store(self.path, self._engine, row_id)

    def measurements(
        self, since: datetime = ALWAYS, until: datetime = NEVER
    ) -> Iterator[MeasurementRecord]:
        """Rows with since <= slot < until, in order, as they are stored.

        Each counts from its own calibration's reference; `read_columns` gives them in one zero,
        and far faster.
        """
        with self._translated():
            for batch in read_columns(self.path, since, until, as_stored=True):
                for values in batch.rows():
                    yield measurement_record(values)

    def past_rows(
        self,
        calibration_id: int,
        reasons: Sequence[str],
        limit: int,
        since: datetime = ALWAYS,
        until: datetime = NEVER,
        *,
        newest: bool = True,
    ) -> PastRows:
        """The last (or first) rows with a value and since <= slot < until, in order.

        Only those by one calibration whose reasons, as the table holds them, are among the given.
        """
        with self._read() as connection:
            return past.past(
                *(connection, calibration_id, reasons, since, until, limit),
                before_id=self._before_id,
                newest=newest,
            )

    def rows_with_targets(
        self, slot_utc: datetime, calibration_id: int, limit: int
    ) -> list[MeasurementRecord]:
        """The last rows before a slot that say something of further targets, in order."""
        with self._read() as connection:
            return past.last_with_targets(
                connection, slot_utc, calibration_id, limit, self._before_id
            )

    def hourly_closures(self, calibration_id: int, since: datetime, until: datetime) -> FloatArray:
        """Closures of a calibration's rows by the hour, see `daemon.store.rows.hourly_closures`."""
        return hourly_closures(self.path, calibration_id, since, until, self._before_id)

    def state_before(self, slot_utc: datetime) -> tuple[int, int]:
        """Changes when another row before a slot is known, or one was dated again."""
        with self._read() as connection:
            return past.state_before(connection, slot_utc, self._before_id)

    def measured_slots(self, since: datetime = ALWAYS, until: datetime = NEVER) -> set[datetime]:
        """The slots that have a row, since <= slot < until."""
        with self._read() as connection:
            return measurements.slots(connection, since, until)

    def reasons(self, since: datetime, until: datetime) -> dict[datetime, str]:
        """The slots with a row, since <= slot < until, in order, with their reasons as stored."""
        with self._read() as connection:
            return measurements.reasons(connection, since, until)

    def last_slot(self) -> datetime | None:
        """The latest slot with a row."""
        with self._read() as connection:
            return measurements.last_slot(connection)

    # Gaps

    def record_gap(
        self,
        first_slot: datetime,
        last_slot: datetime,
        cause: GapCause,
        detail: str = "",
        *,
        period_s: int,
    ) -> int:
        """Record the slots from first to last (both included) as missed; give how many were new.

        Slots that have a row or lie in a gap stay as they are, so that this may be repeated.
        A gap of the same cause that the slots continue is extended and keeps its detail.
        Raises ValueError when the two are not a whole number of periods apart.
        """
        run = run_between(first_slot, last_slot, period_s)
        with self._write() as session:
            return gap_runs.record_missed(session, run, cause, detail)

    def gaps(self, since: datetime = ALWAYS, until: datetime = NEVER) -> list[GapRecord]:
        """Gaps with at least one moment in since <= t < until, whole, in order."""
        with self._read() as connection:
            return Overview(connection).gaps(since, until)

    def cut_gaps_after(self, slot_utc: datetime) -> None:
        """Cut gaps short that go on beyond a slot: a clock that was ahead had put them there."""
        with self._write() as session:
            gap_runs.release_after(session, slot_utc)

    def change_cause(
        self, since: datetime, last: datetime, old: GapCause, new: GapCause, detail: str
    ) -> None:
        """Give the missed slots from `since` to `last` another cause than the one they have."""
        with self._write() as session:
            gap_runs.change_cause(session, since, last, old, new, detail)

    def accounted(self) -> tuple[datetime, datetime] | None:
        """The first and the last slot that has a row or lies in a gap; None when there is none."""
        with self._read() as connection:
            return Overview(connection).accounted()

    def coverage(
        self, since: datetime, until: datetime, *, period_s: int, offset_s: int = 0
    ) -> Coverage:
        """Account for the slots `k * period_s + offset_s` (Unix time), since <= slot < until."""
        slots = schedule_slots(since, until, period_s, offset_s)
        with self._read() as connection:
            return Overview(connection).coverage(slots)

    def missing_slots(self, slots: range) -> Iterator[range]:
        """Those of `slots` (Unix seconds) with neither row nor gap, as runs, in order."""
        return missing_slots(self.path, slots)

    # Calibrations

    def add_calibration(
        self,
        record: CalibrationRecord,
        datum: DatumRecord | None = None,
        *,
        activate: bool = False,
    ) -> int:
        """Store a calibration for good with its datum, active if asked; give its id.

        Raises ValueError for content that is not plain, finite JSON.
        """
        with self._write() as session:
            return calibrations.add(session, record, datum, activate=activate)

    def add_datums(self, links: Mapping[int, DatumRecord]) -> None:
        """Give calibrations, by their numbers, new links: all of them or none."""
        with self._write() as session:
            for calibration_id, link in links.items():
                calibrations.add_datum(session, calibration_id, link)

    def datum_links(self) -> list[DatumRecord]:
        """All links of calibrations to the record's zero, oldest first; the newest ones hold."""
        with self._read() as connection:
            return datum.read_links(connection)

    def datum(self, calibration_id: int | None) -> DatumRecord | None:
        """The link that holds of a calibration."""
        with self._read() as connection:
            return datum.datum_of(connection, calibration_id)

    def active_calibration(self) -> CalibrationRecord | None:
        """The calibration in use."""
        with self._session() as session:
            return calibrations.active(session)

    def calibration(self, calibration_id: int) -> CalibrationRecord | None:
        """One calibration."""
        with self._session() as session:
            return calibrations.find(session, calibration_id)

    def calibrations(self) -> list[CalibrationRecord]:
        """All of them, oldest first."""
        with self._session() as session:
            return calibrations.find_all(session)

    # Frames kept and removed

    def frame_days(self) -> list[FrameDay]:
        """What the frame archive holds of each day that has been counted, in order."""
        with self._session() as session:
            return frame_days.read_all(session)

    def put_frame_day(self, record: FrameDay) -> None:
        """Write or replace what is known of a day's frames."""
        with self._write() as session:
            frame_days.put(session, record)

    def frames_removed(self, slot_utc: datetime) -> bool:
        """Whether the frames that a slot's row names were removed on purpose, by retention.

        Those that are missing otherwise are lost. Rows are never changed: they go on naming them.
        """
        with self._session() as session:
            return frame_days.has_removed(session, slot_utc)

    # The quality ledger

    def add_ledger_entry(self, entry: LedgerEntry) -> int:
        """Add what a person says of the record; give its number. Raises UsageError."""
        with self._write() as session:
            return ledger_rows.add_entry(session, entry)

    # Events and marks

    def add_event(self, time_utc: datetime, kind: str, detail: str = "") -> None:
        """Write one line of the system's history."""
        with self._write() as session:
            events.add(session, time_utc, kind, detail)

    def events(
        self, since: datetime = ALWAYS, until: datetime = NEVER, kind: str | None = None
    ) -> list[EventRecord]:
        """Events with since <= time < until, of one kind if given, in order."""
        with self._session() as session:
            return events.find(session, since, until, kind)

    def set_mark(self, mark: Mark, value: str | None) -> None:
        """Set a mark, or remove it with None."""
        self.set_marks({mark: value})

    def set_marks(self, marks: Mapping[Mark, str | None]) -> None:
        """Set or remove several marks at once."""
        with self._write() as session:
            events.set_marks(session, marks)

    def get_mark(self, mark: Mark) -> str | None:
        """A mark's value, None if not set."""
        with self._read() as connection:
            return Overview(connection).mark(mark)

    # The file

    def backup(self, target: Path, tell: Tell = lambda _done, _total: None) -> Copied:
        """Copy the database consistently, under the running daemon, to a checked, durable file.

        Raises CopyError; an older file of that name is replaced only by a whole one.
        """
        return backup(self.path, target, tell)

    def rescue(self, now_utc: datetime) -> Path:
        """Write what the open file holds to the disk again, after it was removed or replaced.

        Under its own name if that is free, else that of a database set aside. Raises StoreError.
        """
        with translated(self.path), self._engine.connect() as connection:
            held = connection.connection.driver_connection
            return rescue(cast("sqlite3.Connection", held), self.path, now_utc)
