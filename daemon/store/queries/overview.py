"""How a site is, read from its database: few rows, plain SQL, and all of one moment.

`status` is asked every minute by monitoring systems, so that nothing here loads SQLAlchemy, and
nothing reads the rows of a month one by one.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from core.moment import Moment
from core.results import Flag, TargetMeasurement
from daemon.store.integrity.reading import fetch, value, whole_rows
from daemon.store.records import Coverage, DatumRecord, GapCause, GapRecord, Mark, MeasurementRecord
from daemon.store.revisions import require_head
from daemon.store.rows.convert import measurement_record, stored_time
from daemon.store.rows.datum import datum_of, in_record_zero, targets_in_record_zero
from daemon.store.rows.targets import targets_of
from daemon.store.runs import next_second, overlap, run_between, slot_at
from daemon.store.sqlite import connect_readonly, existing_path, said_plainly
from daemon.times import instant_text, slot_text


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
    datum: DatumRecord | None
    """Where its reference lies in the record's zero; None where nobody said so."""
    is_first: bool
    """Whether none was in use before it."""
    reference: Moment | None
    """When its reference was taken, and how warm the rig was."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How the corners of one row fitted."""

    slot_utc: datetime
    sub_residual_px: float
    sub_contrast_dn: float


@dataclass(frozen=True, slots=True)
class ClosureSummary:
    """How large the closures of some rows are, and how large they should be."""

    rows: int
    rms_mm: float
    """Of all x and y."""
    sigma_mm: float
    """rms of their sigmas: what the closures' rms should be."""


@dataclass(frozen=True, slots=True)
class TargetSummary:
    """A further target: what the newest row with any says of it, and how often it was seen."""

    now: TargetMeasurement
    rows: int
    """With a value of the main target, since a time: of those it should have been seen in all."""
    rows_with_value: int
    """Of these, those that have a value of it too."""
    last_value_utc: datetime | None
    """The last slot of any row since then that has one."""


_OTHERS = "SELECT count(*) FROM calibration_activation WHERE calibration_id <> ?"
"""Of activations: how many there were of other calibrations."""


def _moment(utc_s: float | None, celsius: float | None, readings: str | None) -> Moment | None:
    """A calibration's reference, as its stored content has it."""
    return None if utc_s is None else Moment(utc_s, celsius, json.loads(readings or "{}"))


@contextmanager
def open_overview(directory: Path) -> Iterator[Overview]:
    """Open the database of a state directory for one look, beside a running daemon or without.

    Raises DatabaseMissingError, DatabaseDamagedError, DatabaseNewerError, DatabaseOlderError.
    """
    path = existing_path(directory)
    with said_plainly(path), closing(connect_readonly(path)) as connection:
        connection.execute("BEGIN").close()
        overview = Overview(connection)
        require_head(overview.revision(), path)
        yield overview


class Overview:
    """Questions to a connection; its owner begins the transaction and ends it."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def revision(self) -> str | None:
        """The revision of the tables; None where this program never made any."""
        named = "SELECT count(*) FROM sqlite_master WHERE name = 'alembic_version'"
        if not value(self._connection, named):
            return None
        found = value(self._connection, "SELECT version_num FROM alembic_version")
        return None if found is None else str(found)

    def accounted(self) -> tuple[datetime, datetime] | None:
        """The first and the last slot that has a row or lies in a gap; None when there is none."""
        limits = [  # SQLite takes one end of an index a query, not both
            value(self._connection, "SELECT min(slot_utc) FROM measurement"),
            value(self._connection, "SELECT max(slot_utc) FROM measurement"),
            value(self._connection, "SELECT min(start_utc) FROM gap"),
            value(self._connection, "SELECT max(end_utc) FROM gap"),
        ]
        known = [stored_time(text) for text in limits if text is not None]
        return (min(known), max(known)) if known else None

    def last_row(self) -> MeasurementRecord | None:
        """The row of the latest slot that has one, in the record's zero."""
        return self._row("ORDER BY slot_utc DESC LIMIT 1")

    def row(self, slot_utc: datetime) -> MeasurementRecord | None:
        """The row of a slot, in the record's zero; None where it has none."""
        return self._row("WHERE slot_utc = ?", slot_text(slot_utc))

    def _row(self, which: str, *values: str) -> MeasurementRecord | None:
        query = f"SELECT * FROM measurement {which}"  # noqa: S608 - our own words
        found = whole_rows(self._connection, "measurement", query, *values)
        if not found:
            return None
        record = measurement_record(found[0])
        datum = self.datum(record.calibration_id)
        return replace(record, measurement=in_record_zero(record.measurement, datum))

    def datum(self, calibration_id: int | None) -> DatumRecord | None:
        """The link of a calibration to the record's zero."""
        return datum_of(self._connection, calibration_id)

    def last_good_slot(self, since: datetime) -> datetime | None:
        """The latest slot with a good row, not before a time."""
        query = (
            "SELECT slot_utc FROM measurement WHERE slot_utc >= ? AND flag = ?"
            " ORDER BY slot_utc DESC LIMIT 1"
        )
        found = value(self._connection, query, slot_text(next_second(since)), int(Flag.GOOD))
        return None if found is None else stored_time(found)

    def rows_without_frames(self, since: datetime, until: datetime) -> int:
        """How many rows, since <= slot < until, could not keep their frames.

        A late row without frames had a damaged pair, and says so as its reason.
        """
        query = (
            "SELECT count(*) FROM measurement WHERE slot_utc >= ? AND slot_utc < ?"
            " AND main_frame IS NULL AND recorded_late = 0"
        )
        return int(
            value(self._connection, query, *(slot_text(next_second(t)) for t in (since, until)))
        )

    def undated(self) -> int:
        """How many pairs wait for their slots."""
        return int(value(self._connection, "SELECT count(*) FROM undated"))

    def to_measure_again(self) -> int:
        """How many rows of a wrong clock wait to be measured as of their true times."""
        query = "SELECT count(*) FROM redated WHERE again IS NULL"
        return int(value(self._connection, query))

    def gaps(self, since: datetime, until: datetime) -> list[GapRecord]:
        """Gaps with at least one moment in since <= t < until, whole, in order."""
        query = "SELECT * FROM gap WHERE end_utc >= ? AND start_utc < ? ORDER BY start_utc"
        limits = [slot_text(next_second(time)) for time in (since, until)]
        return [
            GapRecord(
                stored_time(row["start_utc"]),
                stored_time(row["end_utc"]),
                row["period_s"],
                GapCause(row["cause"]),
                row["detail"],
            )
            for row in whole_rows(self._connection, "gap", query, *limits)
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
            " json_extract(c.content, '$.setup.levels.sub_contrast_dn'),"
            " json_extract(c.content, '$.reference.utc_s'),"
            " json_extract(c.content, '$.reference.temperature_c'),"
            " json_extract(c.content, '$.reference.readings')"
            " FROM calibration_activation a JOIN calibration c ON c.id = a.calibration_id"
            " ORDER BY a.id DESC LIMIT 1"
        )
        found = fetch(self._connection, query)
        if not found:
            return None
        number, created, method, passed, hash_, verdict, rms_px, contrast_dn, *moment = found[0]
        return ActiveCalibrationSummary(
            number,
            stored_time(created),
            method,
            bool(passed),
            verdict or "",
            hash_,
            rms_px,
            contrast_dn,
            self.datum(number),
            is_first=not value(self._connection, _OTHERS, number),
            reference=_moment(*moment),
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
            row
            for word in reasons
            for row in fetch(self._connection, query, calibration_id, word, begin, limit)
        ]
        return [
            Fit(stored_time(slot), residual_px or 0.0, contrast_dn or 0.0)
            for slot, residual_px, contrast_dn in sorted(found)[-limit:]
        ]

    def closure(self, since: datetime, until: datetime) -> ClosureSummary | None:
        """The closures of since <= slot < until; None without any."""
        query = (  # from an index that holds nothing else
            "SELECT count(*), avg(closure_x_mm * closure_x_mm + closure_y_mm * closure_y_mm),"
            " avg(closure_sigma_x_mm * closure_sigma_x_mm"
            " + closure_sigma_y_mm * closure_sigma_y_mm) FROM measurement"
            " WHERE closure_x_mm IS NOT NULL AND slot_utc >= ? AND slot_utc < ?"
        )
        limits = [slot_text(next_second(time)) for time in (since, until)]
        rows, square_mm2, variance_mm2 = fetch(self._connection, query, *limits)[0]
        if not rows:
            return None
        return ClosureSummary(rows, math.sqrt(square_mm2 / 2), math.sqrt(variance_mm2 / 2))

    def targets(self, since: datetime, until: datetime) -> list[TargetSummary]:
        """The further targets of the newest row with any, in its order, in the record's zero.

        Counted over since <= slot < until; none where no row of that span names any.
        """
        limits = [slot_text(next_second(time)) for time in (since, until)]
        within = "targets IS NOT NULL AND slot_utc >= ? AND slot_utc < ?"
        newest = f"SELECT * FROM measurement WHERE {within} ORDER BY slot_utc DESC LIMIT 1"  # noqa: S608 - our own words
        found = whole_rows(self._connection, "measurement", newest, *limits)
        query = (
            "SELECT json_extract(targets, found.fullkey || '.name'), sum(measured),"  # noqa: S608
            " sum(measured AND there), max(CASE WHEN there THEN slot_utc END) FROM"
            " (SELECT slot_utc, targets, fullkey, x_mm IS NOT NULL AS measured,"
            " json_extract(targets, fullkey || '.x_mm') IS NOT NULL AS there"
            " FROM measurement, json_each(CASE WHEN json_valid(targets) THEN targets ELSE '[]' END)"
            f" WHERE {within}) AS found GROUP BY 1"
        )
        counts = {
            name: (int(rows), int(rows_with_value), last)
            for name, rows, rows_with_value, last in (
                fetch(self._connection, query, *limits) if found else ()
            )
        }
        seen = targets_of(found[0]["targets"]) if found else ()
        datum = self.datum(found[0]["calibration_id"]) if found else None
        return [
            TargetSummary(now, rows, rows_with_value, stored_time(last) if last else None)
            for now in targets_in_record_zero(seen, datum)
            for rows, rows_with_value, last in (counts[now.name],)
        ]

    def events(self, kind: str, since: datetime) -> int:
        """How many events of a kind there were since a time."""
        query = "SELECT count(*) FROM event WHERE time_utc >= ? AND kind = ?"
        return int(value(self._connection, query, instant_text(since), kind))

    def last_event(self, *kinds: str) -> tuple[str, datetime, str] | None:
        """Kind, time and detail of the newest event of some kinds."""
        places = ", ".join("?" * len(kinds))
        query = (
            f"SELECT kind, time_utc, detail FROM event WHERE kind IN ({places})"  # noqa: S608
            " ORDER BY id DESC LIMIT 1"
        )
        found = fetch(self._connection, query, *kinds)
        if not found:
            return None
        kind, time_utc, detail = found[0]
        return str(kind), stored_time(time_utc), str(detail)

    def last_event_of(self, kind: str, name: str) -> datetime | None:
        """When the newest event of a kind was whose detail begins with a name and a colon."""
        query = (
            "SELECT time_utc FROM event WHERE kind = ? AND substr(detail, 1, ?) = ?"
            " ORDER BY id DESC LIMIT 1"
        )
        found = value(self._connection, query, kind, len(name) + 1, f"{name}:")
        return None if found is None else stored_time(found)

    def archive_size(self) -> tuple[int, int]:
        """Days with frames, and bytes of them, as last counted."""
        query = "SELECT count(*), coalesce(sum(bytes), 0) FROM frame_day WHERE bytes > 0"
        days, size = fetch(self._connection, query)[0]
        return int(days), int(size)

    def mark(self, mark: Mark) -> str | None:
        """A mark's value, None if not set."""
        query = "SELECT * FROM mark WHERE name = ?"
        found = whole_rows(self._connection, "mark", query, mark.value)
        return str(found[0]["value"]) if found else None

    def _rows_by_flag(self, slots: range) -> dict[Flag, int]:
        query = (
            "SELECT flag, count(*) FROM measurement WHERE slot_utc BETWEEN ? AND ?"
            " AND (CAST(strftime('%s', slot_utc) AS INTEGER) - ?) % ? = 0 GROUP BY flag"
        )
        limits = (slot_text(slot_at(slots[0])), slot_text(slot_at(slots[-1])))
        found = fetch(self._connection, query, *limits, slots.start, slots.step)
        return {Flag(flag): count for flag, count in found}
