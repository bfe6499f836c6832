"""`dcam-ctl simulate site`: one's own config becomes a trial that runs without hardware."""

from __future__ import annotations

import csv
import re
import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daemon.config.reading import load_config
from drivers.frameset import read_frame_set
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
[[reading]]
name = "air"
unit = "degC"
file = "air"
"""
)


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A site's own config, with real cameras, head and alarm."""
    path = tmp_path / "mine.toml"
    path.write_text(OWN)
    return path


def test_the_copy_differs_in_devices_sensors_clock_state_and_alarm_only(
    ctl: Ctl, own: Path, tmp_path: Path
) -> None:
    ran = ctl("simulate", "site", "--config", own, "--output", tmp_path / "trial")
    assert ran.code == 0
    copy = tmp_path / "trial" / "dcam.toml"
    expected = tomllib.loads(OWN)
    for role in ("main", "sub"):
        expected["camera"][role]["backend"] = "simulated"
    expected["pan_tilt"]["backend"] = "simulated"
    del expected["alarm"]["urls"], expected["reading"]
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


FURTHER = """
[[target.extra]]
name = "abutment"
role = "fixed"
kind = "circles"
centres_mm = [[-7.0, 5.0], [7.0, 5.0], [0.0, 0.0], [-7.0, -5.0], [7.0, -5.0]]
diameter_mm = 4.0
distance_mm = 11200.0
distance_sigma_mm = 20.0
[simulation.climate]
air_seasonal_k = 12.0
[simulation.breathing]
cameras_urad_per_k = [2.0, 2.0, 0.0]
[[simulation.plates]]
name = "abutment"
offset_mm = [50.0, 10.0]
"""


def test_a_season_is_written_as_frame_sets_with_its_truth(
    ctl: Ctl, own: Path, tmp_path: Path
) -> None:
    """Both parts read, with temperatures, plate and breath; the commands name them in turn."""
    own.write_text(OWN.replace(laboratory(640, "aravis"), laboratory(240, "aravis")) + FURTHER)
    trial = tmp_path / "trial"
    season = ("--season", "100", "--rows", "5", "--rebond")
    ran = ctl("simulate", "site", "--config", own, "--output", trial, *season)
    assert ran.code == 0, ran.err
    words = [line.split() for line in ran.out.splitlines()]
    assert [(word[3], Path(word[5]).name) for word in words] == [
        *(("calibrate", "first"), ("reprocess", "first")),
        *(("calibrate", "second"), ("reprocess", "second")),
    ]
    for part, count in (("first", 3), ("second", 2)):
        rows = read_frame_set(trial / part).rows_of("measure")
        assert len(rows) == count
        assert all(row.main_temperature_c is not None for row in rows)
        with (trial / part / "truth.csv").open(newline="") as table:
            truth = list(csv.DictReader(table))
        assert len(truth) == count + 1
        assert {float(row["abutment_x_mm"]) for row in truth} == {0.0}
        assert abs(float(truth[-1]["shift_u_px"])) > 0.01


@pytest.mark.parametrize(
    ("further", "words", "message"),
    [
        (
            FURTHER.replace("[50.0, 10.0]", "[5.0, 10.0]"),
            (),
            r"mine.toml: simulation.plates: 'abutment' would stand over 'main'",
        ),
        (
            FURTHER.replace('plates]]\nname = "abutment"', 'plates]]\nname = "pylon"'),
            (),
            r'mine.toml: simulation.plates\[0\].name: "pylon" is no plate of .*there: "abutment"',
        ),
        ("", ("--season", "1", "--rows", "40"), "--season 1 --rows 40: .*fewer rows or more days"),
    ],
)
def test_what_cannot_be_simulated_is_refused_and_nothing_written(
    ctl: Ctl, own: Path, tmp_path: Path, further: str, words: tuple[str, ...], message: str
) -> None:
    """One line: what, where, what to do."""
    own.write_text(OWN + further)
    trial = tmp_path / "trial"
    ran = ctl("simulate", "site", "--config", own, "--output", trial, *words)
    assert ran.code == (2 if words else 3)
    assert len(ran.err.splitlines()) == 1
    assert re.search(message, ran.err)
    assert not trial.exists()
