"""How a site is, read from its database: few rows, plain SQL, and all of one moment.

`status` is asked every minute by monitoring systems, so that nothing here loads SQLAlchemy, and
nothing reads the rows of a month one by one.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from core.results import Flag
from daemon.errors import DamagedRowError, DatabaseMissingError
from daemon.store.checksum import DIGEST, require_intact
from daemon.store.convert import measurement_record
from daemon.store.records import Coverage, GapCause, GapRecord, Mark, MeasurementRecord
from daemon.store.revisions import require_head
from daemon.store.runs import next_second, overlap, run_between, slot_at
from daemon.store.sqlite import connect_readonly, database_exists, said_plainly
from daemon.times import instant_text, slot_text

FILE_NAME = "dcam.db"

_TIMES = ("slot_utc", "captured_utc", "redated_from_utc")
_TRUTHS = ("recorded_late", "clock_synchronised")


@dataclass(frozen=True, slots=True)
class ActiveCalibrationSummary:
    """What there is to say of the calibration in use without loading it."""

    id: int
    created_utc: datetime
    method: str
    passed: bool
    verdict: str
    """The first line of its report."""
    config_hash: str
    sub_rms_px: float | None
    sub_contrast_dn: float | None
    """How its sub images fitted and looked; None of a calibration that cannot be read."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How the corners of one row fitted."""

    slot_utc: datetime
    sub_residual_px: float
    sub_contrast_dn: float


@contextmanager
def open_overview(directory: Path) -> Iterator[Overview]:
    """Open the database of a state directory for one look, beside a running daemon or without.

    Raises DatabaseMissingError, DatabaseDamagedError, DatabaseNewerError, DatabaseOlderError.
    """
    path = directory / FILE_NAME
    if not database_exists(path):
        raise DatabaseMissingError(missing(path))
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.execute("BEGIN").close()
        overview = Overview(connection)
        require_head(overview.revision(), path)
        yield overview


def missing(path: Path) -> str:
    """What to say of a database that is not there."""
    return f"{path}: no database: start dcamd once, or name another state directory"


class Overview:
    """Questions to a connection; its owner begins the transaction and ends it."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def revision(self) -> str | None:
        """The revision of the tables; None where this program never made any."""
        named = "SELECT count(*) FROM sqlite_master WHERE name = 'alembic_version'"
        if not self._value(named):
            return None
        found = self._value("SELECT version_num FROM alembic_version")
        return None if found is None else str(found)

    def accounted(self) -> tuple[datetime, datetime] | None:
        """The first and the last slot that has a row or lies in a gap; None when there is none."""
        limits = [  # SQLite takes one end of an index a query, not both
            self._value("SELECT min(slot_utc) FROM measurement"),
            self._value("SELECT max(slot_utc) FROM measurement"),
            self._value("SELECT min(start_utc) FROM gap"),
            self._value("SELECT max(end_utc) FROM gap"),
        ]
        known = [time for time in map(_time, limits) if time is not None]
        return (min(known), max(known)) if known else None

    def last_row(self) -> MeasurementRecord | None:
        """The row of the latest slot that has one."""
        query = "SELECT * FROM measurement ORDER BY slot_utc DESC LIMIT 1"
        found = self._rows("measurement", query)
        if not found:
            return None
        (columns,) = found
        columns |= {name: _time(columns[name]) for name in _TIMES}
        columns |= {name: _truth(columns[name]) for name in _TRUTHS}
        return measurement_record(SimpleNamespace(**columns))

    def last_good_slot(self, since: datetime) -> datetime | None:
        """The latest slot with a good row, not before a time."""
        query = (
            "SELECT slot_utc FROM measurement WHERE slot_utc >= ? AND flag = ?"
            " ORDER BY slot_utc DESC LIMIT 1"
        )
        return _time(self._value(query, slot_text(next_second(since)), int(Flag.GOOD)))

    def rows_without_frames(self, since: datetime, until: datetime) -> int:
        """How many rows, since <= slot < until, could not keep their frames.

        A late row without frames had a damaged pair, and says so as its reason.
        """
        query = (
            "SELECT count(*) FROM measurement WHERE slot_utc >= ? AND slot_utc < ?"
            " AND main_frame IS NULL AND recorded_late = 0"
        )
        return int(self._value(query, *(slot_text(next_second(t)) for t in (since, until))))

    def undated(self) -> int:
        """How many pairs wait for their slots."""
        return int(self._value("SELECT count(*) FROM undated"))

    def gaps(self, since: datetime, until: datetime) -> list[GapRecord]:
        """Gaps with at least one moment in since <= t < until, whole, in order."""
        query = "SELECT * FROM gap WHERE end_utc >= ? AND start_utc < ? ORDER BY start_utc"
        limits = [slot_text(next_second(time)) for time in (since, until)]
        return [
            GapRecord(
                datetime.fromisoformat(row["start_utc"]),
                datetime.fromisoformat(row["end_utc"]),
                row["period_s"],
                GapCause(row["cause"]),
                row["detail"],
            )
            for row in self._rows("gap", query, *limits)
        ]

    def coverage(self, slots: range) -> Coverage:
        """Count the fate of each of `slots` (Unix seconds)."""
        if not slots:
            return Coverage(0, 0, 0, 0, 0, {}, 0)
        rows = self._rows_by_flag(slots)
        gaps: dict[GapCause, int] = {}
        for gap in self.gaps(slot_at(slots[0]), slot_at(slots[-1] + 1)):
            run = run_between(gap.first_slot_utc, gap.last_slot_utc, gap.period_s)
            shared = overlap(run, slots)
            if shared:
                gaps[gap.cause] = gaps.get(gap.cause, 0) + shared
        return Coverage(
            expected=len(slots),
            good=rows.get(Flag.GOOD, 0),
            suspect=rows.get(Flag.SUSPECT, 0),
            bad=rows.get(Flag.BAD, 0),
            missing=rows.get(Flag.MISSING, 0),
            gaps=gaps,
            unaccounted=len(slots) - sum(rows.values()) - sum(gaps.values()),
        )

    def calibration(self) -> ActiveCalibrationSummary | None:
        """The calibration in use."""
        query = (
            "SELECT c.id, c.created_utc, c.method, c.passed, c.config_hash,"
            " json_extract(c.report, '$.lines[0]'),"
            " json_extract(c.content, '$.setup.levels.sub_rms_px'),"
            " json_extract(c.content, '$.setup.levels.sub_contrast_dn')"
            " FROM calibration_activation a JOIN calibration c ON c.id = a.calibration_id"
            " ORDER BY a.id DESC LIMIT 1"
        )
        found = self._all(query)
        if not found:
            return None
        number, created, method, passed, hash_, verdict, rms_px, contrast_dn = found[0]
        return ActiveCalibrationSummary(
            number,
            datetime.fromisoformat(created),
            method,
            bool(passed),
            verdict or "",
            hash_,
            rms_px,
            contrast_dn,
        )

    def fits(
        self, calibration_id: int, reasons: tuple[str, ...], since: datetime, limit: int
    ) -> list[Fit]:
        """How the corners fitted in the last rows with a value, of one calibration, in order.

        Only of rows whose reasons, as the table holds them, are among the given.
        """
        query = (
            "SELECT slot_utc, sub_residual_px, sub_contrast_dn FROM measurement"
            " WHERE calibration_id = ? AND reasons = ? AND slot_utc >= ? AND x_mm IS NOT NULL"
            " ORDER BY slot_utc DESC LIMIT ?"
        )
        begin = slot_text(next_second(since))
        found = [
            row for word in reasons for row in self._all(query, calibration_id, word, begin, limit)
        ]
        return [
            Fit(datetime.fromisoformat(slot), residual_px or 0.0, contrast_dn or 0.0)
            for slot, residual_px, contrast_dn in sorted(found)[-limit:]
        ]

    def events(self, kind: str, since: datetime) -> int:
        """How many events of a kind there were since a time."""
        query = "SELECT count(*) FROM event WHERE time_utc >= ? AND kind = ?"
        return int(self._value(query, instant_text(since), kind))

    def last_event(self, *kinds: str) -> tuple[str, datetime, str] | None:
        """Kind, time and detail of the newest event of some kinds."""
        places = ", ".join("?" * len(kinds))
        query = (
            f"SELECT kind, time_utc, detail FROM event WHERE kind IN ({places})"  # noqa: S608
            " ORDER BY id DESC LIMIT 1"
        )
        found = self._all(query, *kinds)
        if not found:
            return None
        kind, time_utc, detail = found[0]
        return str(kind), datetime.fromisoformat(time_utc), str(detail)

    def archive_size(self) -> tuple[int, int]:
        """Days with frames, and bytes of them, as last counted."""
        query = "SELECT count(*), coalesce(sum(bytes), 0) FROM frame_day WHERE bytes > 0"
        days, size = self._all(query)[0]
        return int(days), int(size)

    def mark(self, mark: Mark) -> str | None:
        """A mark's value, None if not set."""
        found = self._value("SELECT value FROM mark WHERE name = ?", mark.value)
        return None if found is None else str(found)

    def _rows_by_flag(self, slots: range) -> dict[Flag, int]:
        query = (
            "SELECT flag, count(*) FROM measurement WHERE slot_utc BETWEEN ? AND ?"
            " AND (CAST(strftime('%s', slot_utc) AS INTEGER) - ?) % ? = 0 GROUP BY flag"
        )
        limits = (slot_text(slot_at(slots[0])), slot_text(slot_at(slots[-1])))
        found = self._all(query, *limits, slots.start, slots.step)
        return {Flag(flag): count for flag, count in found}

    def _rows(self, table: str, query: str, *parameters: Any) -> list[dict[str, Any]]:
        """Whole rows by column, each of which has proved itself."""
        # A cursor of its own: the connection may be another's, who reads plain tuples.
        with closing(self._connection.cursor()) as cursor:
            cursor.row_factory = sqlite3.Row
            rows = [dict(row) for row in cursor.execute(query, parameters)]
        for row in rows:
            require_intact(table, row, row.pop(DIGEST))
        return rows

    def _value(self, query: str, *parameters: Any) -> Any:
        found = self._all(query, *parameters)
        return found[0][0] if found else None

    def _all(self, query: str, *parameters: Any) -> list[Any]:
        with closing(self._connection.cursor()) as cursor:
            return cursor.execute(query, parameters).fetchall()


def _time(text: str | None) -> datetime | None:
    try:
        return None if text is None else datetime.fromisoformat(text)
    except (ValueError, TypeError) as error:
        msg = f"{text!r} is no time"
        raise DamagedRowError(msg) from error


def _truth(number: int | None) -> bool | None:
    return None if number is None else bool(number)
