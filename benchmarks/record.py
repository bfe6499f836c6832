"""What `plot`, `report` and `export` of a long record cost, against fetching its columns.

By itself, with a size and a place to keep the database: `python -m benchmarks.record --help`.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from core.results import (
    CalibrationReport,
    Diagnostics,
    Displacement,
    Flag,
    Measurement,
    RigMotion,
)
from daemon.store.database import Store, open_store
from daemon.store.integrity.checksum_columns import row_digests
from daemon.store.records import CalibrationRecord, CameraState, GapCause, MeasurementRecord
from daemon.times import instant_text, slot_text

CONFIG = Path(__file__).with_name("small.toml")
ROOT = Path(__file__).parents[1]
ROWS = 1_000_000
"""Two years of minutes."""
GAP_EVERY, GAP_SLOTS = 5000, 100
_BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
_MINUTE = timedelta(minutes=1)
_BATCH = 5000
_POLL_S = 0.05

_FETCH = """
import sqlite3, sys
rows = sqlite3.connect(sys.argv[1]).execute("SELECT * FROM measurement ORDER BY slot_utc")
while rows.fetchmany(5000):
    pass
"""
COMMANDS = {
    "plot": ("plot", "--output", "a.png"),
    "report": ("report", "--output", "a.html"),
    "export, Parquet": ("export", "--format", "parquet", "--output", "a.parquet"),
    "export, CSV": ("export", "--output", "a.csv"),
    "export, NetCDF": ("export", "--format", "netcdf", "--output", "a.nc"),
}


@dataclass(frozen=True, slots=True)
class Cost:
    """Of one process."""

    cpu_s: float
    peak_mb: float
    """The most memory that was resident."""


@dataclass(frozen=True, slots=True)
class RecordCost:
    """Of each command, and of Python's `sqlite3` fetching all columns of the same rows."""

    rows: int
    commands: dict[str, Cost]
    fetch: Cost


def measure_record(rows: int = ROWS, state: Path | None = None) -> RecordCost:
    """Fill a database, unless it is there, and run the commands on it."""
    with tempfile.TemporaryDirectory(prefix="dcam-bench-") as scratch:
        directory = state or Path(scratch) / "state"
        if not (directory / "dcam.db").exists():
            fill(directory, rows)
        site = ["--config", str(CONFIG), "--state", str(directory)]
        ctl = [sys.executable, "-m", "daemon.ctl", *site]
        fetch = _cost([sys.executable, "-c", _FETCH, str(directory / "dcam.db")])
        found = {}
        for name, (command, *options) in COMMANDS.items():
            output = str(Path(scratch) / options.pop())
            found[name] = _cost([*ctl, command, *options, output])
        return RecordCost(rows, found, fetch)


def _cost(command: Sequence[str]) -> Cost:
    before, peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN), 0.0
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            peak_mb = max(peak_mb, _peak_mb(process.pid))
            with suppress(subprocess.TimeoutExpired):
                process.wait(_POLL_S)
        said = process.stderr.read() if process.stderr else ""
    if process.returncode != 0:
        msg = f"{command[-5:]} ended with {process.returncode}: {said}"
        raise RuntimeError(msg)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)
    return Cost(cpu_s, peak_mb)


def _peak_mb(pid: int) -> float:
    """The kernel's own high-water mark, so that nothing falls between two looks."""
    try:
        found = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{pid}/status").read_text("ascii"))
    except OSError:
        return 0.0
    return int(found[1]) / 1024.0 if found else 0.0


def fill(directory: Path, rows: int) -> None:
    """Write one row as the daemon would, and others like it with numbers and texts of their own."""
    with open_store(directory) as store:
        report = CalibrationReport(passed=True, lines=("A benchmark.",), figures={})
        calibration = CalibrationRecord(_BEGIN, {"method": "rigid"}, report, "", "")
        number = store.add_calibration(calibration, activate=True)
        store.add_measurement(_first(number))
        with closing(sqlite3.connect(store.path)) as connection, connection:
            for names, batch in _batches(connection, rows):
                places = ", ".join("?" * len(names))
                connection.executemany(
                    f"INSERT INTO measurement ({', '.join(names)}) VALUES ({places})", batch
                )
        _record_gaps(store, rows)


def _first(calibration_id: int) -> MeasurementRecord:
    covariance = np.diag([0.01, 0.04])
    measurement = Measurement(
        Flag.GOOD,
        (),
        Displacement(np.array([0.5, -1.25]), covariance),
        Displacement(np.array([7.0, 9.0]), covariance),
        RigMotion(np.full(3, 1e-4), np.full(3, 0.1), np.eye(6) * 1e-8),
        Diagnostics(5, 870, 0.01, 0.02, 180.5, 190.5, 1.1, 1.2),
        frames_used=1,
    )
    return MeasurementRecord(
        slot_utc=_slot(0),
        measurement=measurement,
        config_hash="0123456789ab",
        version="0.1.0",
        calibration_id=calibration_id,
        skew_s=-0.0012,
        main_frame="main",
        sub_frame="sub",
        captured_utc=_BEGIN,
        boot_id="7c9f8a3e-0000-4000-8000-00805f9b34fb",
        uptime_s=86_400.25,
        clock_synchronised=True,
        main_camera=CameraState(10_000.5, 3.0, 41.5),
        sub_camera=CameraState(800.25, 0.0, 39.0),
    )


def _slot(row: int) -> datetime:
    """The slot of a row: after every GAP_EVERY rows a gap."""
    return _BEGIN + (row + row // GAP_EVERY * GAP_SLOTS) * _MINUTE


def _batches(
    connection: sqlite3.Connection, rows: int
) -> Iterator[tuple[list[str], Iterator[tuple[Any, ...]]]]:
    cursor = connection.execute("SELECT * FROM measurement")
    names = [column[0] for column in cursor.description]
    first = dict(zip(names, cursor.fetchone(), strict=True))
    rng = np.random.default_rng(1)
    for begin in range(1, rows, _BATCH):
        numbers = range(begin, min(begin + _BATCH, rows))
        slots = [_slot(number) for number in numbers]
        columns: dict[str, Sequence[Any]] = {
            name: [value] * len(numbers) for name, value in first.items()
        }
        for name, value in first.items():
            if isinstance(value, float):
                columns[name] = (value * (1.0 + 0.1 * rng.standard_normal(len(numbers)))).tolist()
        columns["id"] = [number + 1 for number in numbers]
        columns["slot_utc"] = [slot_text(slot) for slot in slots]
        columns["captured_utc"] = [instant_text(slot) for slot in slots]
        for role in ("main", "sub"):
            columns[f"{role}_frame"] = [f"frames/{s:%Y/%m/%d/%H%M%S}_{role}.png" for s in slots]
        covariances = 1e-8 * rng.standard_normal((len(numbers), 21))
        columns["motion_covariance"] = [
            json.dumps(line, separators=(",", ":")) for line in covariances.tolist()
        ]
        columns["digest"] = row_digests("measurement", columns)
        yield names, zip(*(columns[name] for name in names), strict=True)


def _record_gaps(store: Store, rows: int) -> None:
    for row in range(GAP_EVERY, rows, GAP_EVERY):
        first = _slot(row) - GAP_SLOTS * _MINUTE
        last = _slot(row) - _MINUTE
        store.record_gap(first, last, GapCause.POWER_LOSS, "bench", period_s=60)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.record", description=__doc__)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--state", type=Path, metavar="DIR", help="keep the database, use it again")
    options = parser.parse_args()
    found = measure_record(options.rows, options.state)
    print(f"{found.rows} rows; sqlite3 fetches them in {found.fetch.cpu_s:.1f} s of CPU time")
    for name, cost in found.commands.items():
        ratio = cost.cpu_s / found.fetch.cpu_s
        print(f"{ratio:5.1f}  {cost.cpu_s:6.1f} s  {cost.peak_mb:4.0f} MB  {name}")


if __name__ == "__main__":
    main()
