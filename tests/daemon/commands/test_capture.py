"""`dcam-ctl capture` takes one pair and prints it; nothing is recorded."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from core.moment import Moment
from daemon.lock import sole_writer
from daemon.store.database import open_store, open_store_readonly
from tests.daemon.commands.conftest import SIMULATED, Ctl


@pytest.fixture
def arguments(calibrated: Path, tmp_path: Path) -> tuple[object, ...]:
    """The calibrated site with its cameras; the world is the one of the frame set."""
    state = shutil.copytree(calibrated, tmp_path / "state")
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    return ("--config", tmp_path / "dcam.toml", "--state", state)


def test_a_pair_is_measured_and_printed(ctl: Ctl, arguments: tuple[object, ...]) -> None:
    """At the start of its story the rig is where it was calibrated."""
    ran = ctl(*arguments, "capture", "--json")
    assert ran.code == 0, ran.err
    document = json.loads(ran.out)
    assert document["schema"] == 1
    assert abs(document["measurement"]["x_mm"]) < 0.3
    assert abs(document["measurement"]["y_mm"]) < 0.3
    assert document["main"]["width_px"] == 640
    text = ctl(*arguments, "capture").out
    assert text.startswith("2026-03-01T00:00:00Z  x ")
    assert "5 discs" in text


def test_the_temperature_of_the_steel_is_in_the_sigma(
    ctl: Ctl, arguments: tuple[object, ...], tmp_path: Path
) -> None:
    """As in a row: what a sensor says now, against the reference."""
    steel = tmp_path / "steel"
    said = '\n[stability]\ntemperature_reading = "steel"\n[[reading]]\nname = "steel"\n'
    said += f'unit = "degC"\nfile = "{steel}"\n'
    (tmp_path / "dcam.toml").write_text(SIMULATED + said)
    with open_store(tmp_path / "state") as store:
        made = store.active_calibration()
        assert made is not None
        cool = Moment(made.created_utc.timestamp(), None, {"steel": 10.0}).to_dict()
        store.add_calibration(
            replace(made, content={**made.content, "reference": cool}, id=None), activate=True
        )
    sigmas_mm = []
    for celsius in (10.0, 60.0):
        steel.write_text(f"{celsius}\n")
        ran = ctl(*arguments, "capture", "--json")
        document = json.loads(ran.out)
        (reading,) = document["readings"]
        assert (reading["name"], reading["value"]) == ("steel", celsius)
        sigmas_mm.append(document["measurement"]["sigma_x_mm"])
    assert sigmas_mm[1] > 1.5 * sigmas_mm[0]


def test_nothing_is_recorded(ctl: Ctl, arguments: tuple[object, ...], tmp_path: Path) -> None:
    ctl(*arguments, "capture")
    with open_store_readonly(tmp_path / "state") as store:
        assert store.last_slot() is None
    assert not (tmp_path / "state" / "frames").exists()


def test_cameras_that_dcamd_has_are_left_to_it(
    ctl: Ctl, arguments: tuple[object, ...], tmp_path: Path
) -> None:
    with sole_writer(tmp_path / "state"):
        ran = ctl(*arguments, "capture")
    assert ran.code == 4
    assert "in use by dcamd" in ran.err


def test_without_a_calibration_there_is_no_value(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "new", "capture")
    assert ran.code == 1
    assert "no value (bad: no_calibration)" in ran.out


def test_without_a_backend_it_says_which_key_to_set(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    ran = ctl("--config", bench / "dcam.toml", "--state", tmp_path / "state", "capture")
    assert ran.code == 3
    assert "camera.main.backend" in ran.err
