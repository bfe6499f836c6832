"""A simulated site, its frame set and a calibrated state; a site whose record is made by hand."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from benchmarks.reprocess import PLATE, WHERE
from core.calibration.calibrate import CalibrationReport
from core.results import Displacement, Flag, Measurement, Reason, RigMotion
from daemon.config.reading import load_config
from daemon.ctl import cli
from daemon.error_report import run
from daemon.lock import sole_writer
from daemon.store.database import Store, open_store
from daemon.store.records import (
    CalibrationRecord,
    CameraState,
    GapCause,
    MeasurementRecord,
    Reading,
)
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.settings import SimPlate, SimSettings
from tests.daemon.rows import add_rows
from tests.laboratory import laboratory
from tests.shared import shared_directory

LABORATORY = laboratory(640)
"""The laboratory site on sensors of a third of the pixels; no backend, as for `--from`."""

CONFIG = laboratory(640, square_mm=4.0)
"""The same with a quarter of the board's corners: a calibration takes a quarter of the time."""

SEED = 3
"""Of the frame set."""


def simulated(config: str) -> str:
    """A site's config with simulated cameras, head and clock."""
    return f"""{config.replace("width_px", 'backend = "simulated"' + chr(10) + "width_px")}
[simulation]
seed = {SEED}
start_utc = 2026-03-01T00:00:00Z
"""


SIMULATED = simulated(CONFIG)
SMALL = simulated(laboratory(320, square_mm=6.0))
"""On half as many pixels a side, for what does not depend on how well a row is known."""

PLAN = FrameSetPlan(intrinsics=8, rig=12, measure=4)


@dataclass(frozen=True, slots=True)
class Ran:
    """What a command did, as seen from outside."""

    code: int
    out: str
    err: str


Ctl = Callable[..., Ran]


@pytest.fixture
def ctl(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Ctl:
    """`dcam-ctl` with these arguments, in an environment without our variables."""
    monkeypatch.delenv("DCAM_CONFIG", raising=False)
    monkeypatch.delenv("DCAM_STATE", raising=False)

    def ran(*arguments: object) -> Ran:
        capfd.readouterr()
        code = run(cli, "dcam-ctl", [str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return Ran(int(code), out, err)

    return ran


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with `dcam.toml`, the frame set `set/` and its `truth.csv`; not to be changed."""

    def fill(directory: Path) -> None:
        (directory / "dcam.toml").write_text(CONFIG)
        site = load_config(directory / "dcam.toml").site()
        write_frame_set(directory / "set", site, SimSettings(seed=SEED), PLAN)

    return shared_directory(tmp_path_factory, "bench", fill)


@pytest.fixture(scope="session")
def calibrated(bench: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state with a calibration made on the frame set; not to be changed."""

    def fill(directory: Path) -> None:
        arguments = ["--config", bench / "dcam.toml", "--state", directory / "state"]
        command = ["calibrate", "--from", bench / "set", "--accept"]
        assert run(cli, "dcam-ctl", [str(word) for word in (*arguments, *command)]) == 0

    made = shared_directory(tmp_path_factory, "calibrated", fill) / "state"
    # SQLite makes and removes files beside a database that is read: each process reads its own.
    return Path(shutil.copytree(made, tmp_path_factory.mktemp("calibrated") / "state"))


@pytest.fixture
def own_set(bench: Path, tmp_path: Path) -> Path:
    """A copy of the frame set that a test may damage."""
    return Path(shutil.copytree(bench / "set", tmp_path / "set"))


def rows_of(table: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def edit_table(directory: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Rewrite `frames.csv` of a set, line by line."""
    table = directory / "frames.csv"
    table.write_text("\n".join(change(table.read_text().splitlines())) + "\n")


FURTHER = f"""
[[target.extra]]
name = "span-2"
role = "measured"
kind = "circles"
centres_mm = [[-8.0, 7.0], [8.0, 7.0], [-3.0, -7.0], [8.0, -7.0]]
diameter_mm = 7.0
distance_mm = 11200.0
distance_sigma_mm = 20.0
{PLATE}"""
HIDDEN_MIN = ((1.5, 2.5), (170.0, 190.0))
"""Slot 2 of a running dcamd, and the last one of the frame set."""
PLATES = (
    SimPlate("span-2", offset_mm=(-53.0, 0.0), bridge_factor=0.5),
    replace(WHERE, hidden_min=HIDDEN_MIN),
)
RUNNING = f"""
[[simulation.plates]]
name = "span-2"
offset_mm = [-53.0, 0.0]
bridge_factor = 0.5

[[simulation.plates]]
name = "abutment"
offset_mm = [53.0, 0.0]
hidden_min = {[list(span) for span in HIDDEN_MIN]}
"""


@pytest.fixture(scope="session")
def further(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame set with two further targets and a state calibrated on it; not to be changed."""

    def fill(directory: Path) -> None:
        (directory / "dcam.toml").write_text(CONFIG + FURTHER)
        site = load_config(directory / "dcam.toml").site()
        write_frame_set(directory / "set", site, SimSettings(seed=SEED, plates=PLATES), PLAN)
        arguments = ["--config", directory / "dcam.toml", "--state", directory / "state"]
        command = ["calibrate", "--from", directory / "set", "--accept"]
        assert run(cli, "dcam-ctl", [str(word) for word in (*arguments, *command)]) == 0

    made = shared_directory(tmp_path_factory, "further", fill)
    own = tmp_path_factory.mktemp("further")  # each process reads its own database
    shutil.copytree(made / "state", own / "state")
    (own / "dcam.toml").write_text(CONFIG + FURTHER)
    (own / "set").symlink_to(made / "set")
    return own


START = datetime(2026, 3, 1, tzinfo=UTC)
MINUTE = timedelta(minutes=1)
GOOD = Measurement(
    Flag.GOOD,
    (),
    Displacement(np.array([0.5, -1.25]), np.diag([0.01, 0.04])),
    Displacement(np.array([7.0, 9.0]), np.diag([0.01, 0.04])),
    RigMotion(np.zeros(3), np.zeros(3), np.eye(6)),
)
DARK = Measurement(Flag.BAD, (Reason.TOO_DARK,), None, None, None)


class Site:
    """A state with an hour of rows, to be changed by a test and looked at from outside."""

    def __init__(self, directory: Path, ctl: Ctl) -> None:
        self._ctl = ctl
        self.config = directory / "dcam.toml"
        self.state = directory / "state"
        self.config.write_text(SIMULATED)
        self.end = START

    def write(self, change: Callable[[Store], None]) -> None:
        """Change the database."""
        with open_store(self.state) as store:
            change(store)

    def measure(
        self,
        minutes: int,
        measurement: Measurement = GOOD,
        frame: str | None = "frames/kept.png",
        **more: CameraState | tuple[Reading, ...],
    ) -> None:
        """Add a row a minute; without a frame where the disk had no room for it."""
        hash_ = load_config(self.config).config_hash()
        slots = [self.end + number * MINUTE for number in range(minutes)]
        self.end += minutes * MINUTE
        rows = [
            MeasurementRecord(
                *(slot, measurement, hash_, "1.0"), main_frame=frame, sub_frame=frame, **more
            )
            for slot in slots
        ]
        with open_store(self.state) as store:
            add_rows(store, rows)

    def miss(self, minutes: int, cause: GapCause) -> None:
        """Add a gap."""
        first, self.end = self.end, self.end + minutes * MINUTE
        last = self.end - MINUTE
        self.write(lambda store: store.record_gap(first, last, cause, "why", period_s=60) or None)

    def calibrate(self, *, passed: bool = True, config_hash: str | None = None) -> None:
        """Add an active calibration."""
        record = CalibrationRecord(
            created_utc=START,
            content={"method": "rigid"},
            report=CalibrationReport(passed, ("the verdict",), {}),
            config_hash=config_hash or load_config(self.config).config_hash(),
            version="1.0",
        )
        self.write(lambda store: store.add_calibration(record, activate=True) and None)

    def ctl(self, *arguments: object) -> Ran:
        """Run a command on this site."""
        return self._ctl("--config", self.config, "--state", self.state, *arguments)

    def status(self, late: timedelta = timedelta(seconds=30), *, running: bool = True) -> Ran:
        """`status --json` so long after the last slot, beside a daemon that holds the lock."""
        at = (self.end - MINUTE + late).isoformat()
        if not running:
            return self.ctl("status", "--json", "--at", at)
        with sole_writer(self.state):
            return self.ctl("status", "--json", "--at", at)

    def levels(self, ran: Ran) -> dict[str, str]:
        """The level of each item."""
        return {item["name"]: item["level"] for item in json.loads(ran.out)["items"]}


@pytest.fixture
def site(tmp_path: Path, ctl: Ctl) -> Site:
    """A calibrated site with ten good rows."""
    made = Site(tmp_path, ctl)
    made.calibrate()
    made.measure(10)
    return made
