"""A damaged database is set aside, never deleted, and what proves itself goes into a new one.

Each step may be cut off and done again. A note beside the database says first under which name it
will be set aside; then the files are renamed; then the new database is built under a temporary
name and renamed; then the note goes. Until it has gone nobody but dcamd opens the database.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import structlog
from sqlalchemy import exists, func, select
from sqlalchemy.orm import Session, aliased

from daemon.durable import fsync_directory, fsync_file, temporary_name
from daemon.store.damage_note import (
    COMPANIONS,
    SET_ASIDE,
    Note,
    clear_note,
    read_note,
    write_note,
)
from daemon.store.engine import make_engine, translated
from daemon.store.integrity.digest import CheckedSession
from daemon.store.migrate import known_revisions, upgrade
from daemon.store.records import GapCause, Mark
from daemon.store.rows.gaps import record_missed
from daemon.store.runs import run_between
from daemon.store.salvage.damage import has_foreign_log
from daemon.store.salvage.row_salvage import Carried, carry_over
from daemon.store.salvage.sqlite_pages import PageFile
from daemon.store.schema import (
    ActivationRow,
    CalibrationRow,
    DatumRow,
    EventRow,
    MarkRow,
    MeasurementRow,
    RedatedRow,
)
from daemon.store.sqlite import connect
from daemon.version import VERSION

_log = structlog.get_logger("dcam.daemon")

_SUFFIXES = (*COMPANIONS, "")
"""The database itself goes last: as long as it is there, the rest is not all moved."""

LOST = "lost"
"""The method of a calibration of which nothing but its number is left."""

_FIRST_PAGES = 64
"""The revision stands in one of them."""

Tell = Callable[[int, int], None]


def salvage(path: Path, why: str, now_utc: datetime, tell: Tell) -> None:
    """Set a damaged database aside and put a new one with all that can be read in its place.

    Goes on with a salvage that was cut off. Raises OSError, DiskFullError, StoreError.
    """
    directory = path.parent
    note = read_note(directory) or Note(why)
    if note.aside is None:
        note = replace(note, why=why, aside=_free_name(directory, now_utc))
        write_note(directory, note)
    aside = directory / str(note.aside)
    _log.error("database_damaged", why=note.why, set_aside=str(aside))
    if not aside.exists():
        _set_aside(path, aside)
    if not path.exists():
        _build(path, aside, note, now_utc, tell)
    clear_note(directory)


def _free_name(directory: Path, now_utc: datetime) -> str:
    name = f"{SET_ASIDE}{now_utc.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    number = 1
    while (directory / name).exists():
        number += 1
        name = f"{name.partition('.again-')[0]}.again-{number}"
    return name


def _set_aside(path: Path, aside: Path) -> None:
    for suffix in _SUFFIXES:
        source = path.with_name(path.name + suffix)
        target = aside.with_name(aside.name + suffix)
        if not source.exists():
            continue
        if target.exists():  # moved before a cut; a reader has made an empty one since
            source.unlink()
        else:
            source.rename(target)
    if not aside.exists():  # it was missing: its log may still hold rows
        aside.touch()
    fsync_directory(path.parent)


def _build(path: Path, aside: Path, note: Note, now_utc: datetime, tell: Tell) -> None:
    temporary = temporary_name(path)
    for suffix in _SUFFIXES:
        temporary.with_name(temporary.name + suffix).unlink(missing_ok=True)
    with translated(path):
        if aside.is_file():
            with closing(PageFile(aside, with_log=not has_foreign_log(aside))) as pages:
                carried = _carry(pages, temporary, tell)
        else:
            carried = _new(temporary)
        _finish(temporary, carried, note, now_utc)
        with closing(connect(temporary)) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").close()
    fsync_file(temporary)
    temporary.rename(path)
    fsync_directory(path.parent)


def _new(temporary: Path, revision: str | None = None) -> Carried:
    engine = make_engine(temporary)
    try:
        upgrade(engine, revision)
    finally:
        engine.dispose()
    return Carried()


def _carry(pages: PageFile, temporary: Path, tell: Tell) -> Carried:
    """Carry rows over at the revision that they were written at, then migrate.

    Where that revision cannot be read it is the newest one that rows fit.
    """
    written_at = _revision(pages)
    for revision in [written_at] if written_at else known_revisions()[::-1]:
        _new(temporary, revision)
        with closing(connect(temporary)) as target:
            target.execute("PRAGMA synchronous=OFF").close()  # synced once it is complete
            carried = carry_over(pages, target, tell)
        if carried.rows.total() or carried.gaps or not carried.rejected:
            return carried
        temporary.unlink()
    return _new(temporary)


def _revision(pages: PageFile) -> str | None:
    known = known_revisions()
    for row in pages.rows(last=_FIRST_PAGES):
        if len(row.values) == 1 and row.values[0] in known and not row.guessed:
            return str(row.values[0])
    return None


def _finish(temporary: Path, carried: Carried, note: Note, now_utc: datetime) -> None:
    """Bring the new database to this version, enter gaps, and say in it what happened."""
    engine = make_engine(temporary)
    try:
        upgrade(engine)
        with CheckedSession(engine) as session, session.begin():
            _remove_moved(session)
            _enter_gaps(session, carried)
            _stand_in_for_lost_calibrations(session, now_utc)
            _restore_activation(session, now_utc)
            account = _account(session, carried, note)
            session.add(EventRow(time_utc=now_utc, kind="database_salvaged", detail=account))
            session.merge(MarkRow(name=Mark.SALVAGED.value, value=account))
    finally:
        engine.dispose()
    _log.error("database_salvaged", detail=account)


def _enter_gaps(session: Session, carried: Carried) -> None:
    for gap in carried.gaps:
        try:
            first, last = (
                datetime.fromisoformat(str(gap[end])) for end in ("start_utc", "end_utc")
            )
            run, cause = (
                run_between(first, last, int(str(gap["period_s"]))),
                GapCause(str(gap["cause"])),
            )
        except ValueError:  # of a revision without checksums
            carried.rejected += 1
            continue
        record_missed(session, run, cause, str(gap["detail"]))
        carried.rows["gap"] += 1


def _remove_moved(session: Session) -> None:
    """An older page may have given a row under the slot that a wrong clock had given it."""
    row, left, back = MeasurementRow, RedatedRow, aliased(RedatedRow)
    came_back = exists().where(back.row_id == row.id, back.slot_utc == row.slot_utc)
    went_away = (left.row_id == row.id) & (left.from_slot_utc == row.slot_utc)
    for moved in session.scalars(select(row).join(left, went_away).where(~came_back)).unique():
        session.delete(moved)


def _stand_in_for_lost_calibrations(session: Session, now_utc: datetime) -> None:
    """Rows go on naming the calibration they were measured with; no new one gets its id."""
    measured_with = session.scalars(select(MeasurementRow.calibration_id).distinct())
    named = {number for number in measured_with if number is not None}
    for table in (ActivationRow, DatumRow):
        named |= set(session.scalars(select(table.calibration_id)))
    lost = named - set(session.scalars(select(CalibrationRow.id)))
    line = "lost with the damaged database: calibrate again, from its frames if they were kept"
    for number in sorted(lost):
        session.add(
            CalibrationRow(
                id=number,
                created_utc=now_utc,
                method=LOST,
                passed=False,
                content=json.dumps({"method": LOST}),
                report=json.dumps({"lines": [line], "figures": {}}),
                config_hash="",
                version=VERSION,
            )
        )
    session.flush()


def _restore_activation(session: Session, now_utc: datetime) -> None:
    """Where the newest row was measured with another calibration than the last one activated.

    That one's activation was lost; unless the other was activated after that row.
    """
    newest = session.scalar(
        select(MeasurementRow)
        .where(MeasurementRow.calibration_id.is_not(None))
        .order_by(MeasurementRow.id.desc())
        .limit(1)
    )
    active = session.scalar(select(ActivationRow).order_by(ActivationRow.id.desc()).limit(1))
    if newest is None or (active and active.calibration_id == newest.calibration_id):
        return
    if active is None or active.activated_utc < newest.slot_utc:
        session.add(ActivationRow(calibration_id=newest.calibration_id, activated_utc=now_utc))


def _account(session: Session, carried: Carried, note: Note) -> str:
    """What was kept and lost, in one line; rows are numbered, so that missing ones show."""
    rows = session.scalar(select(func.count()).select_from(MeasurementRow)) or 0
    lost = (session.scalar(select(func.max(MeasurementRow.id))) or 0) - rows
    kept = f"{rows} rows, {carried.rows['gap']} gaps, {carried.rows['calibration']} calibrations"
    loss = f"lost at least {lost} rows" if lost else "no row before the last one kept is missing"
    parts = [f"{note.why}; set aside as {note.aside}; kept {kept}; {loss}"]
    if carried.rejected:
        parts.append(f"{carried.rejected} entries were not what was written")
    if carried.unreadable_pages:
        parts.append(f"{carried.unreadable_pages} pages could not be read from the disk")
    return "; ".join(parts)
