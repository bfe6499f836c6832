"""The database: every slot's row or gap, calibrations, events and marks, durable when it returns.

Each method is one transaction. What has returned is on the disk (WAL, synchronous=FULL); what
raised has changed nothing. A store may be used from several threads; readers never wait for the
writer, nor it for them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Self, cast

from sqlalchemy import Engine, func, or_, select
from sqlalchemy.orm import Session

from daemon.durable import fsync_directory, make_directory_durable
from daemon.errors import (
    TO_SALVAGE,
    DatabaseDamagedError,
    DatabaseMissingError,
    DatabaseUnwritableError,
    SlotTakenError,
    StoreError,
)
from daemon.store import frame_days, undated
from daemon.store import gaps as gap_runs
from daemon.store.accounting import audit_slots
from daemon.store.convert import (
    calibration_record,
    calibration_row,
    measurement_record,
    measurement_row,
)
from daemon.store.copying import Copied, Tell, backup, copy_out
from daemon.store.digest import CheckedSession
from daemon.store.engine import make_engine, translated
from daemon.store.migrate import migrate as run_migrations
from daemon.store.migrate import require_head
from daemon.store.overview import FILE_NAME, Overview, missing
from daemon.store.records import (
    CalibrationRecord,
    Coverage,
    EventRecord,
    FrameDay,
    GapCause,
    GapRecord,
    Mark,
    MeasurementRecord,
)
from daemon.store.runs import next_second, run_between, schedule_slots
from daemon.store.salvage.damage import Depth, find_damage, traces_of_a_lost_database
from daemon.store.salvage.damage_note import COMPANIONS, SET_ASIDE
from daemon.store.schema import ActivationRow, CalibrationRow, EventRow, MarkRow, MeasurementRow
from daemon.store.sqlite import (
    connect,
    connect_readonly,
    database_exists,
    said_plainly,
    undo_half_made,
)
from daemon.times import slot_text

ALWAYS = datetime(1, 1, 1, tzinfo=UTC)
NEVER = datetime(9999, 12, 31, tzinfo=UTC)
"""The stretch [ALWAYS, NEVER) holds everything."""

_PAGE = 500


def open_store(
    directory: Path,
    *,
    create: bool = True,
    migrate: bool = True,
    now_utc: datetime | None = None,
    checked: bool = False,
) -> Store:
    """Open the database of a state directory for writing; make or migrate it as allowed.

    Its newest rows are looked at, unless it was `checked` before; it is saved under a dated name
    (of `now_utc`) before a migration.
    Raises DatabaseMissingError, DatabaseDamagedError, DatabaseNewerError, DatabaseOlderError.
    """
    path = directory / FILE_NAME
    undo_half_made(path)
    exists = database_exists(path)
    if not exists and not create:
        raise DatabaseMissingError(missing(path))
    if not exists and not checked and (traces := traces_of_a_lost_database(path)):
        msg = f"{path}: missing beside {traces}: {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    try:
        make_directory_durable(directory)
    except OSError as error:
        msg = f"{directory}: cannot be made ({error.strerror}): check the path and its permissions"
        raise DatabaseUnwritableError(msg) from error
    if exists and not checked and (found := find_damage(path, Depth.NEWEST)):
        msg = f"{path}: damaged ({found}): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    engine = make_engine(path)
    try:
        if migrate:
            run_migrations(engine, path, now_utc or datetime.now(UTC))
            fsync_directory(directory)
        else:
            require_head(engine, path)
    except BaseException:
        engine.dispose()
        raise
    return Store(path, engine)


def database_bytes(directory: Path) -> int:
    """The size of the database of a state directory; 0 as long as there is none."""
    try:
        return (directory / FILE_NAME).stat().st_size
    except OSError:
        return 0


def open_store_readonly(directory: Path) -> Store:
    """Open the database for reading beside a running daemon, or without one.

    Raises DatabaseMissingError, DatabaseDamagedError, DatabaseNewerError, DatabaseOlderError.
    """
    path = directory / FILE_NAME
    if not database_exists(path):
        raise DatabaseMissingError(missing(path))
    engine = make_engine(path, readonly=True)
    try:
        require_head(engine, path)
    except BaseException:
        engine.dispose()
        raise
    return Store(path, engine)


class Store:
    """An open database; use `open_store` or `open_store_readonly`."""

    def __init__(self, path: Path, engine: Engine) -> None:
        self.path = path
        self.damage: DatabaseDamagedError | None = None
        """What was met first of the file's damage; whoever opened it should close and end."""
        self._engine = engine
        self._writer = engine.execution_options(dcam_begin="IMMEDIATE")

    def __enter__(self) -> Self:
        return self

    def rescue(self, now_utc: datetime) -> Path:
        """Write what the open file holds to the disk again, after it was removed or replaced.

        Under its own name if that is free, else under the name of a database set aside. Raises
        StoreError.
        """
        target = self.path
        if target.exists():
            target = target.with_name(f"{SET_ASIDE}{now_utc.astimezone(UTC):%Y%m%dT%H%M%SZ}")
        with translated(self.path), self._engine.connect() as connection:
            held = connection.connection.driver_connection
            copy_out(cast("sqlite3.Connection", held), self.path, target)
        if target == self.path:  # they belong to the removed file, whose commits the copy has
            for suffix in COMPANIONS:
                target.with_name(target.name + suffix).unlink(missing_ok=True)
        return target

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()

    # Measurements

    def add_measurement(self, record: MeasurementRecord) -> None:
        """Write one slot's row; a gap that holds the slot shrinks or splits around it.

        Raises SlotTakenError when the slot has a row already, StoreError for a measurement that
        is not finite.
        """
        with self._write() as session:
            self._add(session, record)

    def measurement(self, slot_utc: datetime) -> MeasurementRecord | None:
        """The row of a slot."""
        with self._read() as session:
            row = self._row(session, slot_utc)
            return None if row is None else measurement_record(row)

    def measurements(
        self, since: datetime = ALWAYS, until: datetime = NEVER
    ) -> Iterator[MeasurementRecord]:
        """Rows with since <= slot < until, in the order of their slots.

        Read in pages, each in a transaction of its own: a slow reader of many years keeps
        neither memory nor the write-ahead log.
        """
        since, until = next_second(since), next_second(until)
        after = since - timedelta(seconds=1) if since > ALWAYS else since
        while True:
            page = self._page(after, until)
            yield from page
            if len(page) < _PAGE:
                return
            after = page[-1].slot_utc

    def rows_before(
        self, slot_utc: datetime, calibration_id: int, reasons: Sequence[str], limit: int
    ) -> list[MeasurementRecord]:
        """The last rows with a value before a slot, by one calibration, in order.

        Only those whose reasons, as the table holds them, are among the given.
        """
        row = MeasurementRow
        kin = select(row).where(
            row.calibration_id == calibration_id,
            row.slot_utc < next_second(slot_utc),
            row.x_mm.is_not(None),
        )
        last = kin.order_by(row.slot_utc.desc()).limit(limit)
        with self._read() as session:
            # One after the other, so that the index gives the last ones of each without a search.
            rows = [
                found
                for word in reasons
                for found in session.scalars(last.where(row.reasons == word))
            ]
            rows.sort(key=lambda found: found.slot_utc)
            return [measurement_record(found) for found in rows[-limit:]]

    def first_row_after(
        self, slot_utc: datetime, calibration_id: int, reasons: str
    ) -> MeasurementRecord | None:
        """The first row after a slot, by one calibration, with these reasons."""
        row = MeasurementRow
        query = select(row).where(
            row.slot_utc > slot_utc, row.calibration_id == calibration_id, row.reasons == reasons
        )
        with self._read() as session:
            found = session.scalar(query.order_by(row.slot_utc).limit(1))
            return None if found is None else measurement_record(found)

    def measured_slots(self, since: datetime = ALWAYS, until: datetime = NEVER) -> set[datetime]:
        """The slots that have a row, since <= slot < until."""
        column = MeasurementRow.slot_utc
        since, until = next_second(since), next_second(until)
        query = select(column).where(column >= since, column < until)
        with self._read() as session:
            return set(session.scalars(query))

    def last_slot(self) -> datetime | None:
        """The latest slot with a row."""
        with self._read() as session:
            return session.scalar(select(func.max(MeasurementRow.slot_utc)))

    def accounted(self) -> tuple[datetime, datetime] | None:
        """The first and the last slot that has a row or lies in a gap; None when there is none."""
        with self._look() as overview:
            return overview.accounted()

    # Times put right

    def add_undated(self, record: MeasurementRecord) -> None:
        """Keep a pair that was taken while the clock was before the last slot.

        Raises StoreError for a measurement that is not finite, or that does not know its boot.
        """
        try:
            row = undated.undated_row(record)
        except ValueError as error:
            msg = f"{self.path}: what was taken at {record.captured_utc} cannot be kept: {error}"
            raise StoreError(msg) from error
        with self._write() as session:
            session.add(row)

    def undate(self, record: MeasurementRecord) -> None:
        """Turn a row into an undated pair, as the record says: its time is known to be wrong."""
        with self._write() as session:
            session.delete(self._row(session, record.slot_utc))
            session.add(undated.undated_row(record))

    def undated(self, boot_id: str | None = None) -> list[tuple[int, MeasurementRecord]]:
        """What waits for its slot, of one boot if given: ids and records as taken, in order."""
        with self._read() as session:
            return undated.undated_records(session, boot_id)

    def date(self, undated_id: int, record: MeasurementRecord) -> None:
        """Write the row of an undated pair whose slot is known now. Raises as add_measurement."""
        with self._write() as session:
            self._add(session, record)
            undated.forget(session, undated_id)

    def move_row(self, from_slot_utc: datetime, record: MeasurementRecord) -> None:
        """Give a row that a wrong clock had dated its true slot; all else in it stays.

        Its `redated_from_utc` keeps the slot that it had first. Raises SlotTakenError, and
        StoreError when no row is there.
        """
        with self._write() as session:
            row = self._row(session, from_slot_utc)
            if row is None:
                msg = f"{self.path}: slot {slot_text(from_slot_utc)} has no row"
                raise StoreError(msg)
            self._require_free(session, record.slot_utc)
            gap_runs.release(session, record.slot_utc)
            row.slot_utc, row.captured_utc = record.slot_utc, record.captured_utc
            row.main_frame, row.sub_frame = record.main_frame, record.sub_frame
            row.redated_from_utc = record.redated_from_utc

    def last_slot_but(self, boot_id: str) -> datetime | None:
        """The latest slot with a row, but for what a boot took under an undisciplined clock."""
        row = MeasurementRow
        query = select(row.slot_utc).where(
            or_(row.boot_id.is_distinct_from(boot_id), row.clock_synchronised.is_not(False))
        )
        with self._read() as session:
            return session.scalar(query.order_by(row.slot_utc.desc()).limit(1))

    def unsynchronised_rows(self, boot_id: str) -> list[MeasurementRecord]:
        """The rows that a boot took while nothing disciplined the clock, in order."""
        row = MeasurementRow
        query = select(row).where(row.boot_id == boot_id, row.clock_synchronised.is_(False))
        with self._read() as session:
            return [measurement_record(found) for found in session.scalars(query.order_by(row.id))]

    def moved_from(self, since: datetime = ALWAYS) -> set[datetime]:
        """Slots, from `since` on, whose row was moved to another: their frames belong to that."""
        column = MeasurementRow.redated_from_utc
        with self._read() as session:
            found = session.scalars(select(column).where(column >= next_second(since)))
            return {slot for slot in found if slot is not None}

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

    def missing_slots(self, slots: range) -> Iterator[range]:
        """Those of `slots` (Unix seconds) with neither row nor gap, as runs, in order.

        Each short stretch is looked at by itself, so that no writer waits and no log grows.
        """
        with said_plainly(self.path), closing(connect_readonly(self.path)) as connection:
            for fate in audit_slots(connection, slots):
                yield from fate.missing_slots

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
        since, until = next_second(since), next_second(until)
        with self._read() as session:
            rows = gap_runs.gaps_touching(session, since, until)
            return [gap_runs.gap_record(row) for row in rows if row.start_utc < until]

    def coverage(
        self, since: datetime, until: datetime, *, period_s: int, offset_s: int = 0
    ) -> Coverage:
        """Account for the slots `k * period_s + offset_s` (Unix time), since <= slot < until."""
        slots = schedule_slots(since, until, period_s, offset_s)
        with self._look() as overview:
            return overview.coverage(slots)

    # Calibrations

    def add_calibration(self, record: CalibrationRecord, *, activate: bool = False) -> int:
        """Store a calibration for good, and make it the active one if told; give its id.

        Raises ValueError for content that is not plain, finite JSON.
        """
        row = calibration_row(record)
        with self._write() as session:
            session.add(row)
            session.flush()
            if activate:
                session.add(ActivationRow(calibration_id=row.id, activated_utc=record.created_utc))
            return row.id

    def activate_calibration(self, calibration_id: int, time_utc: datetime) -> None:
        """Measure with this calibration from now on. Raises StoreError when there is none."""
        with self._write() as session:
            if session.get(CalibrationRow, calibration_id) is None:
                msg = f"{self.path}: no calibration {calibration_id}: choose one that is listed"
                raise StoreError(msg)
            session.add(ActivationRow(calibration_id=calibration_id, activated_utc=time_utc))

    def active_calibration(self) -> CalibrationRecord | None:
        """The calibration in use."""
        newest = select(func.max(ActivationRow.id)).scalar_subquery()
        query = select(CalibrationRow).join(ActivationRow).where(ActivationRow.id == newest)
        with self._read() as session:
            row = session.scalar(query)
            return None if row is None else calibration_record(row)

    def calibration(self, calibration_id: int) -> CalibrationRecord | None:
        """One calibration."""
        with self._read() as session:
            row = session.get(CalibrationRow, calibration_id)
            return None if row is None else calibration_record(row)

    def calibrations(self) -> list[CalibrationRecord]:
        """All of them, oldest first."""
        with self._read() as session:
            rows = session.scalars(select(CalibrationRow).order_by(CalibrationRow.id))
            return [calibration_record(row) for row in rows]

    # Frames kept and removed

    def frame_days(self) -> list[FrameDay]:
        """What the frame archive holds of each day that has been counted, in order."""
        with self._read() as session:
            return frame_days.read_all(session)

    def put_frame_day(self, record: FrameDay) -> None:
        """Write or replace what is known of a day's frames."""
        with self._write() as session:
            frame_days.put(session, record)

    def frames_removed(self, slot_utc: datetime) -> bool:
        """Whether the frames that a slot's row names were removed on purpose, by retention.

        Those that are missing otherwise are lost. Rows are never changed: they go on naming them.
        """
        with self._read() as session:
            found = frame_days.read(session, slot_utc.astimezone(UTC).date())
            return found is not None and found.has_removed(slot_utc)

    def reasons(self, since: datetime, until: datetime) -> dict[datetime, str]:
        """The slots with a row, since <= slot < until, in order, with their reasons as stored."""
        row, (since, until) = MeasurementRow, map(next_second, (since, until))
        query = select(row.slot_utc, row.reasons).where(row.slot_utc >= since, row.slot_utc < until)
        with self._read() as session:
            found = session.execute(query.order_by(row.slot_utc))
            return {one.slot_utc: one.reasons for one in found}

    # Events and marks

    def add_event(self, time_utc: datetime, kind: str, detail: str = "") -> None:
        """Write one line of the system's history."""
        with self._write() as session:
            session.add(EventRow(time_utc=time_utc, kind=kind, detail=detail))

    def events(
        self, since: datetime = ALWAYS, until: datetime = NEVER, kind: str | None = None
    ) -> list[EventRecord]:
        """Events with since <= time < until, of one kind if given, in order."""
        column = EventRow.time_utc
        query = select(EventRow).where(column >= since, column < until)
        if kind is not None:
            query = query.where(EventRow.kind == kind)
        with self._read() as session:
            rows = session.scalars(query.order_by(column, EventRow.id))
            return [EventRecord(row.time_utc, row.kind, row.detail) for row in rows]

    def set_mark(self, mark: Mark, value: str | None) -> None:
        """Set a mark, or remove it with None."""
        self.set_marks({mark: value})

    def set_marks(self, marks: Mapping[Mark, str | None]) -> None:
        """Set or remove several marks at once."""
        with self._write() as session:
            for mark, value in marks.items():
                row = session.get(MarkRow, mark.value)
                if value is not None:
                    session.merge(MarkRow(name=mark.value, value=value))
                elif row is not None:
                    session.delete(row)

    def get_mark(self, mark: Mark) -> str | None:
        """A mark's value, None if not set."""
        with self._read() as session:
            row = session.get(MarkRow, mark.value)
            return None if row is None else row.value

    # The file

    def backup(self, target: Path, tell: Tell = lambda _done, _total: None) -> Copied:
        """Copy the database consistently, under the running daemon, to a checked, durable file.

        Raises DatabaseUnwritableError; an older file of that name is replaced only by a whole one.
        """
        if target.exists() and target.samefile(self.path):
            msg = f"{target}: is the database itself: choose another name"
            raise StoreError(msg)
        return backup(self.path, target, tell)

    def checkpoint(self) -> None:
        """Move the write-ahead log into the file and empty it, as far as readers allow."""
        with translated(self.path), closing(connect(self.path)) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").close()

    def close(self) -> None:
        """Close all connections; the last one empties the write-ahead log."""
        self._engine.dispose()

    @contextmanager
    def _read(self) -> Iterator[Session]:
        with self._translated(), CheckedSession(self._engine) as session:
            yield session

    @contextmanager
    def _write(self) -> Iterator[Session]:
        with self._translated(), CheckedSession(self._writer) as session, session.begin():
            yield session

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            with translated(self.path):
                yield
        except DatabaseDamagedError as error:
            self.damage = self.damage or error
            raise

    def _add(self, session: Session, record: MeasurementRecord) -> None:
        try:
            row = measurement_row(record)
        except ValueError as error:
            msg = f"{self.path}: slot {slot_text(record.slot_utc)} cannot be stored: {error}"
            raise StoreError(msg) from error
        self._require_free(session, record.slot_utc)
        gap_runs.release(session, record.slot_utc)
        session.add(row)

    def _require_free(self, session: Session, slot_utc: datetime) -> None:
        if self._row(session, slot_utc) is not None:
            msg = f"{self.path}: slot {slot_text(slot_utc)} has a row already"
            raise SlotTakenError(msg)

    @contextmanager
    def _look(self) -> Iterator[Overview]:
        with self._read() as session:
            connection = session.connection().connection.dbapi_connection
            yield Overview(cast("sqlite3.Connection", connection))

    def _row(self, session: Session, slot_utc: datetime) -> MeasurementRow | None:
        query = select(MeasurementRow).where(MeasurementRow.slot_utc == slot_utc)
        return session.scalar(query)

    def _page(self, after: datetime, until: datetime) -> list[MeasurementRecord]:
        column = MeasurementRow.slot_utc
        query = select(MeasurementRow).where(column > after, column < until)
        with self._read() as session:
            rows = session.scalars(query.order_by(column).limit(_PAGE))
            return [measurement_record(row) for row in rows]
