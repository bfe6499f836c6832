"""How long `dcam-ctl status` takes in a fresh process, beside 145 days of rows with gaps."""

from __future__ import annotations

import resource
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from core.results import Displacement, Flag, Measurement, RigMotion
from daemon.store.database import open_store
from daemon.store.records import GapCause, MeasurementRecord

CONFIG = Path(__file__).with_name("small.toml")
ROOT = Path(__file__).parents[1]
SLOTS = 208_800
GAP_EVERY, GAP_SLOTS = 5000, 100
RUNS = 7
_BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
_MINUTE = timedelta(minutes=1)
_GOOD = Measurement(
    Flag.GOOD,
    (),
    Displacement(np.array([0.5, -1.25]), np.diag([0.01, 0.04])),
    Displacement(np.array([7.0, 9.0]), np.diag([0.01, 0.04])),
    RigMotion(np.zeros(3), np.zeros(3), np.eye(6)),
)


@dataclass(frozen=True, slots=True)
class StatusCost:
    """Processor time of whole commands, the least of several runs."""

    status_s: float
    nothing_s: float
    """Of `python -c pass`."""


def measure_status() -> StatusCost:
    """Fill a database and ask for its status, as a monitoring system does."""
    with tempfile.TemporaryDirectory(prefix="dcam-bench-") as state:
        _fill(Path(state))
        at = (_BEGIN + SLOTS * _MINUTE).isoformat()
        where = ["--config", str(CONFIG), "--state", state]
        status = [sys.executable, "-m", "daemon.ctl", *where, "status", "--at", at]
        nothing = [sys.executable, "-c", "pass"]
        return StatusCost(
            min(_time_s(status, 2) for _ in range(RUNS)),
            min(_time_s(nothing, 0) for _ in range(RUNS)),
        )


def _time_s(command: list[str], exit_code: int) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if ran.returncode != exit_code:
        msg = f"{command[1:3]} ended with {ran.returncode}: {ran.stdout}{ran.stderr}"
        raise RuntimeError(msg)
    return (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)


def _fill(state: Path) -> None:
    """Write the first and the last row as the daemon would, and copies of the first between."""
    with open_store(state) as store:
        for slot_utc in (_BEGIN, _BEGIN + (SLOTS - 1) * _MINUTE):
            store.add_measurement(MeasurementRecord(slot_utc, _GOOD, config_hash="", version=""))
        with closing(sqlite3.connect(store.path)) as connection, connection:
            found = connection.execute("SELECT name FROM pragma_table_info('measurement')")
            names = ", ".join(name for (name,) in found if name not in {"id", "slot_utc"})
            connection.execute(
                f"INSERT INTO measurement (slot_utc, {names}) WITH RECURSIVE k(i) AS"
                " (SELECT 1 UNION ALL SELECT i + 1 FROM k WHERE i < ?) SELECT"
                " strftime('%Y-%m-%dT%H:%M:%SZ', ? + 60 * i, 'unixepoch'),"
                f" {names} FROM k, (SELECT * FROM measurement WHERE id = 1) WHERE i % ? >= ?",
                (SLOTS - 2, int(_BEGIN.timestamp()), GAP_EVERY, GAP_SLOTS),
            )
        for begin in range(GAP_EVERY, SLOTS, GAP_EVERY):
            first = _BEGIN + begin * _MINUTE
            last = first + (GAP_SLOTS - 1) * _MINUTE
            store.record_gap(first, last, GapCause.POWER_LOSS, "bench", period_s=60)
