"""`dcam-ctl simulate site`: one's own config becomes a trial that runs without hardware."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daemon.config.reading import load_config
from tests.daemon.commands.conftest import Ctl
from tests.laboratory import laboratory

OWN = (
    "# surveyed by the county\n"
    + laboratory(640, "aravis")
    + """
[pan_tilt]
backend = "ptu"            # on the tripod
port = "/dev/ttyUSB0"
[alarm]
urls = ["mailto://pier:secret@example.org"]
"""
)


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A site's own config, with real cameras, head and alarm."""
    path = tmp_path / "mine.toml"
    path.write_text(OWN)
    return path


def test_the_copy_differs_in_devices_clock_state_and_alarm_only(
    ctl: Ctl, own: Path, tmp_path: Path
) -> None:
    ran = ctl("simulate", "site", "--config", own, "--output", tmp_path / "trial")
    assert ran.code == 0
    copy = tmp_path / "trial" / "dcam.toml"
    expected = tomllib.loads(OWN)
    for role in ("main", "sub"):
        expected["camera"][role]["backend"] = "simulated"
    expected["pan_tilt"]["backend"] = "simulated"
    del expected["alarm"]["urls"]
    expected |= {"storage": {"directory": "state"}, "simulation": {"clock": "stepped"}}
    assert tomllib.loads(copy.read_text()) == expected
    assert "# surveyed by the county" in copy.read_text()
    assert "# on the tripod" in copy.read_text()
    assert "secret" not in copy.read_text()
    assert load_config(copy).config_hash() == load_config(own).config_hash()


def test_the_commands_that_it_prints_run_on_the_copy(ctl: Ctl, own: Path, tmp_path: Path) -> None:
    lines = ctl("simulate", "site", "--config", own, "--output", tmp_path / "trial").out
    commands = [line.split() for line in lines.splitlines()]
    assert [words[3] for words in commands] == [
        *("check", "calibrate", "capture", "--max-slots", "plot"),
    ]
    check, _, capture, *_ = commands
    assert "backend simulated" in ctl(*check[1:]).out
    assert "640x400 px" in ctl(*capture[1:]).out


def test_on_the_machines_clock_the_scenarios_begin_later(
    ctl: Ctl, own: Path, tmp_path: Path
) -> None:
    trial = tmp_path / "trial"
    words = ("simulate", "site", "--config", own, "--output", trial, "--clock", "system")
    before = datetime.now(UTC) + timedelta(minutes=20)
    assert ctl(*words).code == 0
    simulation = load_config(trial / "dcam.toml").simulation
    assert simulation.clock == "system"
    assert simulation.start_utc > before


@pytest.mark.parametrize("there", ["a trial", "a file"])
def test_nothing_that_is_there_is_overwritten(
    ctl: Ctl, own: Path, tmp_path: Path, there: str
) -> None:
    trial = tmp_path / "trial"
    if there == "a trial":
        trial.mkdir()
        (trial / "dcam.toml").write_text("mine")
    else:
        trial.write_text("mine")
    ran = ctl("simulate", "site", "--config", own, "--output", trial)
    assert ran.code == 2
    assert len(ran.err.splitlines()) == 1
    assert "name another" in ran.err
    assert (trial / "dcam.toml" if there == "a trial" else trial).read_text() == "mine"
