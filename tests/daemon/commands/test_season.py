"""A long record: exports equal what the database holds, peaks are seen, damage is named."""

from __future__ import annotations

import csv
import json
import math
import os
import pty
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import h5netcdf
import numpy as np
import pyarrow.parquet as pq
import pytest

from benchmarks.record import fill
from daemon.store.checksum import row_digest
from daemon.store.columns import BATCH
from daemon.store.database import open_store
from daemon.store.records import GapCause
from tests.daemon.commands.conftest import SIMULATED, Ctl
from tests.daemon.store.examples import slot

ROWS = BATCH + 700
"""More than stand in memory together; a gap of 100 slots lies after the first 5000."""


class Season:
    """A site whose database holds many rows and a gap."""

    def __init__(self, ctl: Ctl, directory: Path) -> None:
        self._ctl = ctl
        self.directory = directory
        self.database = directory / "state" / "dcam.db"
        (directory / "dcam.toml").write_text(SIMULATED, encoding="utf-8")

    def run(self, *arguments: object) -> Any:
        paths = ("--config", self.directory / "dcam.toml", "--state", self.directory / "state")
        return self._ctl(*arguments, *paths)

    def export(self, file_format: str, *options: object) -> Path:
        path = self.directory / f"a.{file_format}"
        ran = self.run("export", "--format", file_format, "--output", path, *options)
        assert ran.code == 0, ran.err
        return path

    def stored(self) -> list[dict[str, Any]]:
        """What Python's `sqlite3` reads of the rows."""
        with closing(sqlite3.connect(self.database)) as connection:
            connection.row_factory = sqlite3.Row
            query = "SELECT * FROM measurement ORDER BY slot_utc"
            return [dict(row) for row in connection.execute(query)]

    def damage(self, row: int, change: str) -> None:
        """Change a row past its checksum."""
        with closing(sqlite3.connect(self.database)) as connection, connection:
            statement = f"UPDATE measurement SET {change} WHERE id = ?"
            assert connection.execute(statement, (row,)).rowcount == 1


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("season")
    fill(directory, ROWS)
    return directory / "dcam.db"


@pytest.fixture
def season(ctl: Ctl, tmp_path: Path, filled: Path) -> Season:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "dcam.db").write_bytes(filled.read_bytes())
    return Season(ctl, tmp_path)


def rows_of(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in table if int(row["flag"]) != 9]


def test_parquet_equals_the_database_row_by_row(season: Season) -> None:
    exported = rows_of(pq.read_table(season.export("parquet")).to_pylist())
    stored = season.stored()
    assert len(exported) == len(stored) == ROWS
    for row, kept in zip(exported, stored, strict=True):
        for name, value in row.items():
            expected = kept.get(name)
            if isinstance(value, datetime):
                expected = datetime.fromisoformat(str(expected))
            assert value == expected, (kept["slot_utc"], name)


def test_csv_equals_the_database_to_the_digits_that_it_writes(season: Season) -> None:
    with season.export("csv").open(encoding="utf-8", newline="") as file:
        exported = rows_of(list(csv.DictReader(file)))
    stored = season.stored()
    assert len(exported) == len(stored) == ROWS
    for row, kept in zip(exported, stored, strict=True):
        for name, text in row.items():
            expected = kept.get(name)
            if isinstance(expected, float):
                assert float(text) == pytest.approx(expected, rel=0, abs=6e-4), name
                if name.endswith(("_mm", "_px")):
                    assert float(text) == pytest.approx(expected, rel=0, abs=6e-7), name
                if name.endswith("_rad"):
                    assert float(text) == pytest.approx(expected, rel=0, abs=6e-10), name
            elif name in {"recorded_late", "clock_synchronised"}:
                assert text == str(bool(expected)).lower()
            else:
                assert text == ("" if expected is None else str(expected)), name


def test_netcdf_equals_the_database_row_by_row(season: Season) -> None:
    stored = season.stored()
    with h5netcdf.File(season.export("netcdf")) as file:
        measured = file["flag"][...] != 9
        assert measured.sum() == len(stored) == ROWS
        times = file["time"][...][measured]
        slots = [datetime.fromisoformat(row["slot_utc"]).timestamp() for row in stored]
        assert times.tolist() == slots
        for name in ("x_mm", "rz_rad", "uptime_s", "discs_found", "calibration_id"):
            assert file[name][...][measured].tolist() == [row[name] for row in stored]
        frames = file["main_frame"][...][measured]
        assert [frame.decode() for frame in frames] == [row["main_frame"] for row in stored]
        covariances = file["motion_covariance"][...][measured]
        assert covariances.tolist() == [json.loads(row["motion_covariance"]) for row in stored]


@pytest.mark.parametrize("file_format", ["csv", "parquet", "netcdf"])
def test_a_slot_in_a_gap_is_a_line_with_flag_9_its_cause_and_detail(
    season: Season, file_format: str
) -> None:
    """Slots one after the other, none twice, none left out: 5000 rows, 100 missed, the rest."""
    path = season.export(file_format)
    if file_format == "netcdf":
        with h5netcdf.File(path) as file:
            slots = [datetime.fromtimestamp(time, UTC) for time in file["time"][...]]
            flags, x_mm = file["flag"][...].tolist(), file["x_mm"][...].tolist()
            reasons, details = ([t.decode() for t in file[n][...]] for n in ("reasons", "detail"))
    else:
        if file_format == "csv":
            with path.open(encoding="utf-8", newline="") as text:
                table: list[dict[str, Any]] = list(csv.DictReader(text))
        else:
            table = pq.read_table(path).to_pylist()
        slots = [datetime.fromisoformat(str(row["slot_utc"])) for row in table]
        flags = [int(row["flag"]) for row in table]
        reasons, details = ([row[name] or "" for row in table] for name in ("reasons", "detail"))
        x_mm = [float(row["x_mm"] or "nan") for row in table]
    assert slots == [slot(number) for number in range(ROWS + 100)]
    in_gap = [5000 <= number < 5100 for number in range(ROWS + 100)]
    assert [flag == 9 for flag in flags] == in_gap
    assert [reason == "power_loss" for reason in reasons] == in_gap
    assert [detail == "bench" for detail in details] == in_gap
    assert [math.isnan(x) for x in x_mm] == in_gap


def test_a_span_cuts_a_gap_too(season: Season) -> None:
    span = ("--since", slot(5090).isoformat(), "--until", slot(5102).isoformat())
    with season.export("csv", *span).open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["flag"] for row in table] == ["9"] * 10 + ["1"] * 2


def test_a_gap_longer_than_what_stands_in_memory_is_written_in_order(
    ctl: Ctl, tmp_path: Path
) -> None:
    """Before the first row, between rows whatever the periods, and after the last."""
    season = Season(ctl, tmp_path)
    count = 2 * BATCH + 10
    fill(tmp_path / "state", 3)
    with open_store(tmp_path / "state") as store:
        for first in (slot(-count), slot(3)):
            last = first + timedelta(minutes=count - 1)
            store.record_gap(first, last, GapCause.STOPPED, period_s=60)
        offset = timedelta(seconds=20)  # of a schedule before
        store.record_gap(
            slot(0) + offset, slot(1) + offset, GapCause.CRASH, "<the plug>", period_s=60
        )
    with season.export("csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    slots = [datetime.fromisoformat(row["slot_utc"]) for row in table]
    assert slots == sorted(
        [slot(n) for n in range(-count, count + 3)] + [slot(0) + offset, slot(1) + offset]
    )
    assert [row["detail"] for row in table if row["reasons"] == "crash"] == ["<the plug>"] * 2


@pytest.fixture(scope="module")
def with_a_peak(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """100,000 rows of which one, in the middle, is 40 mm higher than all others."""
    directory = tmp_path_factory.mktemp("peak")
    fill(directory / "state", 100_000)
    lift(directory / "state" / "dcam.db", 54_324)
    return directory


def lift(database: Path, row: int) -> None:
    """Give a row another value, with the checksum of a daemon that wrote it."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.row_factory = sqlite3.Row
        values = dict(
            connection.execute("SELECT * FROM measurement WHERE id = ?", (row,)).fetchone()
        )
        values["y_mm"] += 40.0
        update = "UPDATE measurement SET y_mm = ?, digest = ? WHERE id = ?"
        connection.execute(update, (values["y_mm"], row_digest("measurement", values), row))


def test_a_peak_of_one_row_among_100000_is_seen_in_the_picture(
    ctl: Ctl, tmp_path: Path, with_a_peak: Path
) -> None:
    """The corrected line, in its colour, reaches the top of its panel in one column of pixels."""
    (tmp_path / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    paths = ("--config", tmp_path / "dcam.toml", "--state", with_a_peak / "state")
    assert ctl("plot", "--output", tmp_path / "a.svg", *paths).code == 0
    root = ET.parse(tmp_path / "a.svg").getroot()
    drawn = [
        path
        for path in root.iter("{http://www.w3.org/2000/svg}path")
        if "stroke: #0072b2; stroke-width: 1.4" in path.get("style", "")
    ]
    numbers = drawn[0].get("d", "").replace("M", "").replace("L", "").split()
    points = np.array(numbers, dtype=np.float64).reshape(-1, 2)
    top, bulk = points[:, 1].min(), np.median(points[:, 1])
    height = points[:, 1].max() - top
    assert bulk - top > 0.9 * height
    (at,) = np.unique(points[points[:, 1] < top + 0.1 * height, 0])
    left, right = points[:, 0].min(), points[:, 0].max()
    # Two gaps of 100 slots in 10,000: the row's share of time is its share of rows.
    assert (at - left) / (right - left) == pytest.approx(0.54324, abs=0.002)


DAMAGE = {
    "a number": "y_mm = y_mm + 1e-9",
    "a text": "boot_id = 'b'",
    "no text": "version = CAST(x'ff41' AS TEXT)",
    "a number for NULL": "spread_x_mm = 0.1",
    "NULL for a number": "skew_s = NULL",
    "text for a number": "main_gain_db = 'x'",
    "no checksum": "digest = NULL",
}
COMMANDS = {
    "export": ("export", "--output", "a.csv"),
    "parquet": ("export", "--format", "parquet", "--output", "a.parquet"),
    "plot": ("plot", "--output", "a.png"),
    "report": ("report", "--output", "a.html"),
}


@pytest.mark.parametrize(
    ("command", "damage"),
    [("export", damage) for damage in DAMAGE]
    + [(command, "a number") for command in ("parquet", "plot", "report")],
)
def test_a_damaged_row_in_the_middle_is_named_and_nothing_is_written(
    season: Season, tmp_path: Path, command: str, damage: str
) -> None:
    season.damage(5301, DAMAGE[damage])
    *words, output = COMMANDS[command]
    ran = season.run(*words, tmp_path / output)
    assert ran.code == 5
    assert f"slot_utc {slot(5400):%Y-%m-%dT%H:%M:%SZ}" in ran.err
    assert "is not what was written" in ran.err
    assert ran.err.count("error") == 1
    assert not (tmp_path / output).exists()


@pytest.mark.parametrize("command", ["export", "plot", "report"])
def test_progress_is_shown_on_a_terminal(season: Season, tmp_path: Path, command: str) -> None:
    """Rows done and rows in all, while they are read."""
    *words, output = COMMANDS[command]
    paths = ("--config", season.directory / "dcam.toml", "--state", season.database.parent)
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "daemon.ctl", *words, tmp_path / output, *paths],
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        env=os.environ | {"TERM": "xterm", "COLUMNS": "100"},
    ) as process:
        os.close(theirs)
        said = b""
        with suppress(OSError):  # EIO: the other end is closed
            while part := os.read(ours, 4096):
                said += part
    os.close(ours)
    assert process.returncode == 0, said
    assert f"/{ROWS}" in said.decode()
