"""A record to look at: years of minutes, written by SQL in one statement, and frames of some."""

from __future__ import annotations

import math
import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from core.results import (
    CalibrationReport,
    Diagnostics,
    Displacement,
    Flag,
    Measurement,
    Reason,
    RigMotion,
    TargetMeasurement,
)
from core.site import Site, TargetRole
from daemon.store.database import Store, open_store
from daemon.store.integrity.checksum_columns import row_digests
from daemon.store.records import (
    CalibrationRecord,
    CameraState,
    GapCause,
    MeasurementRecord,
    Reading,
)
from daemon.times import slot_text
from drivers.frameset import encode_png
from drivers.sim.settings import SimSettings
from drivers.sim.world import World

FIRST = datetime(2026, 3, 1, tzinfo=UTC)
MINUTE = timedelta(minutes=1)
PEAK_MM = 9.0
"""Of one row, in a record that stays within 3 mm."""
GAP_EVERY, GAP_SLOTS = 5000, 100
FLAG_EVERY, FLAG_SLOTS, FLAG_AT = 1000, 10, 500
"""Every other run of flagged rows is suspect, the others are bad."""
SUSPECT = Reason.SUB_TARGET_PARTLY_HIDDEN
BAD = Reason.TOO_DARK

SIGNED = 50_000
"""Rows whose checksums are made to fit."""

_INSERT = """
INSERT INTO measurement (slot_utc, flag, reasons, x_mm, y_mm, raw_x_mm, raw_y_mm, closure_x_mm,
  closure_y_mm, rx_rad, main_temperature_c, sub_temperature_c, readings, targets, {others})
WITH RECURSIVE k(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM k WHERE i < :slots - 1),
wave AS (SELECT i, CASE WHEN i % :flag_every BETWEEN :flag_at AND :flag_at + :flag_slots - 1
    THEN 3 + i / :flag_every % 2 ELSE 1 END AS f, sin(i / 229.183) AS day, sin(i / 83700.0) AS year,
    random() / 9.3e18 AS a, random() / 9.3e18 AS b FROM k
  WHERE i % :gap_every >= :gap_slots OR i < :gap_every)
SELECT strftime('%Y-%m-%dT%H:%M:%SZ', :first + 60 * i, 'unixepoch'), f,
  CASE f WHEN 3 THEN :suspect WHEN 4 THEN :bad ELSE '' END,
  iif(f = 4, NULL, 0.4 * day + 0.05 * a),
  iif(f = 4, NULL, iif(i = :peak, :peak_mm, 0.9 * day + year + 0.05 * b)),
  iif(f = 4, NULL, 2.4 * day + 0.05 * a),
  iif(f = 4, NULL, 0.9 * day + year + 3 * day * day + 0.05 * b),
  iif(f = 4, NULL, 0.02 * a), iif(f = 4, NULL, 0.02 * b), 1e-3 * day * day + 1e-6 * a,
  35 + 6 * day + 0.2 * a, 33 + 6 * day + 0.2 * b,
  printf('{{"air":[%.2f,"degC"],"wind":[%.1f,"m/s"]}}', 12 + 6 * day + 8 * year, 3 + 2 * abs(a)),
  targets, {others}
FROM wave, (SELECT * FROM measurement WHERE id = 1)
"""
_COMPUTED = {
    *("id", "slot_utc", "flag", "reasons", "x_mm", "y_mm", "raw_x_mm", "raw_y_mm", "rx_rad"),
    *("closure_x_mm", "closure_y_mm", "main_temperature_c", "sub_temperature_c"),
    *("readings", "targets"),
}


@dataclass(frozen=True, slots=True)
class PageRecord:
    """What was written."""

    last: datetime
    """The last slot; the last ones have frames."""
    peak: datetime
    """The one row of `PEAK_MM`."""
    gap: datetime
    """First slot of the first gap."""
    suspect: datetime
    """First slot of the last run of suspect rows."""


def write_record(state: Path, site: Site, slots: int, *, framed: int = 3) -> PageRecord:
    """Fill a new state directory: rows, gaps, runs of flagged rows, events, frames at the end."""
    peak = slots // 2 // FLAG_EVERY * FLAG_EVERY + FLAG_EVERY // 3
    with open_store(state) as store:
        report = CalibrationReport(
            passed=True,
            lines=("Passed: held-out positions agree within their sigma.", "13 positions used."),
            figures={"rms_px": 0.0123},
        )
        content = {"method": "rigid"}
        calibration = CalibrationRecord(FIRST - 60 * MINUTE, content, report, "", "")
        number = store.add_calibration(calibration, activate=True)
        store.add_measurement(_first(number))
        _insert(store.path, slots, peak)
        for begin in range(GAP_EVERY, slots, GAP_EVERY):
            first, end = FIRST + begin * MINUTE, min(begin + GAP_SLOTS, slots)
            last = FIRST + (end - 1) * MINUTE
            store.record_gap(first, last, GapCause.POWER_LOSS, "mains", period_s=60)
            store.add_event(first, "power_lost", "mains")
        _write_frames(store, site, slots, framed)
        _sign(store.path, FIRST + peak * MINUTE)
    run = (slots - FLAG_AT - FLAG_SLOTS) // (2 * FLAG_EVERY) * 2 * FLAG_EVERY
    return PageRecord(
        FIRST + (slots - 1) * MINUTE,
        FIRST + peak * MINUTE,
        FIRST + GAP_EVERY * MINUTE,
        FIRST + (run + FLAG_AT) * MINUTE,
    )


def _insert(path: Path, slots: int, peak: int) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        columns = connection.execute("SELECT name FROM pragma_table_info('measurement')")
        others = ", ".join(name for (name,) in columns if name not in _COMPUTED)
        connection.execute(
            _INSERT.format(others=others),
            {
                "slots": slots,
                "first": int(FIRST.timestamp()),
                "peak": peak,
                "peak_mm": PEAK_MM,
                "gap_every": GAP_EVERY,
                "gap_slots": GAP_SLOTS,
                "flag_every": FLAG_EVERY,
                "flag_at": FLAG_AT,
                "flag_slots": FLAG_SLOTS,
                "suspect": SUSPECT.value,
                "bad": BAD.value,
            },
        )


def _sign(path: Path, peak: datetime) -> None:
    """Give the last rows, those before today, and that of the peak, the checksums they need.

    Of all rows it would take minutes; figures are drawn without looking at them.
    """
    with closing(sqlite3.connect(path)) as connection, connection:
        rows = connection.execute(
            "SELECT * FROM measurement WHERE slot_utc = ? UNION"
            " SELECT * FROM (SELECT * FROM measurement ORDER BY slot_utc DESC LIMIT ?) UNION"
            " SELECT * FROM (SELECT * FROM measurement WHERE slot_utc <= ?"
            " ORDER BY slot_utc DESC LIMIT ?)",
            (slot_text(peak), SIGNED, f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}", SIGNED),
        )
        names = [name for name, *_ in rows.description]
        columns = dict(zip(names, zip(*rows.fetchall(), strict=True), strict=True))
        digests = row_digests("measurement", columns)
        connection.executemany(
            "UPDATE measurement SET digest = ? WHERE id = ?",
            zip(digests, columns["id"], strict=True),
        )


def _first(calibration_id: int) -> MeasurementRecord:
    """The row that the others are copies of, but for what a person looks at."""
    covariance = np.diag([0.02**2, 0.025**2])
    value = Displacement(np.array([0.0, 0.0]), covariance)
    further = (
        TargetMeasurement("quarter", TargetRole.MEASURED, Flag.GOOD, (), value, value),
        TargetMeasurement("abutment", TargetRole.FIXED, Flag.GOOD, (), value, value),
    )
    return MeasurementRecord(
        slot_utc=FIRST,
        measurement=Measurement(
            *(Flag.GOOD, (), value, value),
            RigMotion(np.full(3, 1e-4), np.full(3, 0.1), np.eye(6) * 1e-12),
            Diagnostics(5, 210, 0.01, 0.02, 180.5, 190.5, 1.1, 1.2),
            frames_used=1,
            closure=value,
            targets=further,
        ),
        config_hash="0123456789ab",
        version="0.1.0",
        calibration_id=calibration_id,
        skew_s=-0.0012,
        captured_utc=FIRST,
        boot_id="7c9f8a3e-0000-4000-8000-00805f9b34fb",
        uptime_s=86_400.25,
        clock_synchronised=True,
        main_camera=CameraState(10_000.5, 3.0, 41.5),
        sub_camera=CameraState(800.25, 0.0, 39.0),
        readings=(Reading("air", "degC", 12.0), Reading("wind", "m/s", 3.0)),
    )


def _write_frames(store: Store, site: Site, slots: int, framed: int) -> None:
    """One rendered pair: the frames of the last slots, and of noon of the days before."""
    world = World(site, SimSettings(seed=3, start_utc=FIRST))
    end = FIRST + (slots - 1) * MINUTE
    days = min(30, math.floor(slots / 1440))
    noons = [end.replace(hour=12, minute=0) - timedelta(days=day) for day in range(1, days)]
    at = [end - number * MINUTE for number in range(framed)] + [t for t in noons if t > FIRST]
    source = store.path.parent / "frames"
    paths = {}
    for role in ("main", "sub"):
        paths[role] = source / f"{role}.png"
        source.mkdir(exist_ok=True)
        paths[role].write_bytes(encode_png(world.render(role, FIRST), world.settings.sensor.bits))
    with closing(sqlite3.connect(store.path)) as connection, connection:
        for slot in at:
            names = {role: f"frames/{slot:%Y/%m/%d/%H%M%S}_{role}.png" for role in paths}
            for role, name in names.items():
                (store.path.parent / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(paths[role], store.path.parent / name)
            connection.execute(
                "UPDATE measurement SET main_frame = ?, sub_frame = ? WHERE slot_utc = ?",
                (names["main"], names["sub"], slot_text(slot)),
            )
    for path in paths.values():
        path.unlink()
