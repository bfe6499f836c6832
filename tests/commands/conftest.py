"""A small simulated site, its frame set and a calibrated state, made once for all command tests."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from daemon.config.reading import load_config
from daemon.ctl import cli
from daemon.errors import run
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.settings import SimSettings
from tests.laboratory import laboratory

CONFIG = laboratory(640)
"""The laboratory site on sensors of a third of the pixels; no backend, as for `--from`."""

SEED = 3
"""Of the frame set; the board's squares are only 13 px wide, as hard as it gets."""

SIMULATED = (
    CONFIG.replace("width_px", 'backend = "simulated"\nwidth_px')
    + f"""
[simulation]
seed = {SEED}
start_utc = 2026-03-01T00:00:00Z
"""
)
"""The same site with simulated cameras, head and clock."""

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
    directory = tmp_path_factory.mktemp("bench")
    (directory / "dcam.toml").write_text(CONFIG)
    site = load_config(directory / "dcam.toml").site()
    write_frame_set(directory / "set", site, SimSettings(seed=SEED), PLAN)
    return directory


@pytest.fixture(scope="session")
def calibrated(bench: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state with a calibration made on the frame set; not to be changed."""
    state = tmp_path_factory.mktemp("calibrated") / "state"
    arguments = ["--config", bench / "dcam.toml", "--state", state]
    command = ["calibrate", "--from", bench / "set", "--accept"]
    assert run(cli, "dcam-ctl", [str(word) for word in (*arguments, *command)]) == 0
    return state


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
