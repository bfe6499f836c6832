"""A season of a breathing rig through the commands: true values, honest sigmas, one zero."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from core.arrays import FloatArray
from daemon.config.reading import load_config
from drivers.sim.season_writer import SeasonPlan, write_season
from drivers.sim.settings import Breathing, Climate, SimPlate, SimSettings
from tests.daemon.commands.conftest import Ctl
from tests.laboratory import laboratory
from tests.shared import shared_directory

FIXED = """
[[target.extra]]
name = "abutment"
role = "fixed"
kind = "circles"
centres_mm = [[-7.5, 5.5], [7.5, 5.5], [0.0, 0.0], [-7.5, -5.5], [7.5, -5.5]]
diameter_mm = 4.0
distance_mm = 11125.0
"""
ALONE = laboratory(960, square_mm=4.0)
CONFIG = ALONE + FIXED
SETTINGS = SimSettings(
    seed=11,
    climate=Climate(air_daily_k=5.0, air_seasonal_k=12.0, air_weather_k=2.0, camera_lag_h=1.0),
    breathing=Breathing(
        cameras_urad_per_k=(1.5, -1.5, 1.0),
        cameras_urad_per_sqrt_day=(1.2, 1.2, 0.5),
        main_px_per_k=(0.02, -0.01),
    ),
    plates=(SimPlate("abutment", offset_mm=(45.0, 0.0)),),
)
PLAN = SeasonPlan(days=100.0, measure=(6, 4), intrinsics=6, rig=8)
Rows = list[dict[str, str]]


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two parts; between them the board is bonded again. The zero is the first reference."""

    def fill(directory: Path) -> None:
        config = directory / "dcam.toml"
        config.write_text(CONFIG)
        write_season(directory / "parts", load_config(config).site(), SETTINGS, PLAN)

    return shared_directory(tmp_path_factory, "season", fill)


def measured(ctl: Ctl, season: Path, directory: Path, config: str, part: str) -> Rows:
    """Calibrate on a part, continuing the state, and measure its rows."""
    directory.mkdir(exist_ok=True)
    (directory / "dcam.toml").write_text(config)
    words = ("--config", directory / "dcam.toml", "--state", directory / "state")
    frames, output = season / "parts" / part, directory / f"{part}.csv"
    done = ctl(*words, "calibrate", "--from", frames, "--accept")
    assert done.code == 0, done.err
    done = ctl(*words, "reprocess", "--from", frames, "--output", output)
    assert done.code == 0, done.err
    with output.open(newline="") as file:
        return list(csv.DictReader(file))


def errors_mm(season: Path, part: str, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """(n, 2) errors and sigmas."""
    with (season / "parts" / part / "truth.csv").open(newline="") as file:
        truth = {row["slot_utc"]: row for row in csv.DictReader(file)}
    pairs = [(row, truth[row["slot_utc"]]) for row in rows]
    error = [[float(r[k]) - float(t[k]) for k in ("x_mm", "y_mm")] for r, t in pairs]
    sigma = [[float(row[f"sigma_{axis}_mm"]) for axis in "xy"] for row in rows]
    return np.array(error), np.array(sigma)


def test_with_a_fixed_target_both_parts_are_true_in_one_zero(
    ctl: Ctl, season: Path, tmp_path: Path
) -> None:
    for part in ("first", "second"):
        rows = measured(ctl, season, tmp_path, CONFIG, part)
        assert [row["flag"] for row in rows] == ["1"] * len(rows)
        error, sigma = errors_mm(season, part, rows)
        assert np.sqrt((error**2).mean()) < 0.02
        assert np.abs(error).max() < 0.06
        assert (np.abs(error) < 3.0 * sigma).all()
        closure = np.array([[float(row[f"closure_{axis}_mm"]) for axis in "xy"] for row in rows])
        assert np.abs(closure).max() > 0.1  # what would have been wrong without it
        own = np.array([[float(row[f"abutment_{axis}_mm"]) for axis in "xy"] for row in rows])
        np.testing.assert_allclose(own, closure, atol=1e-5)


def test_without_it_the_sigma_says_so(ctl: Ctl, season: Path, tmp_path: Path) -> None:
    rows = measured(ctl, season, tmp_path, ALONE, "first")
    error, sigma = errors_mm(season, "first", rows)
    assert np.abs(error).max() > 0.1
    assert (np.abs(error) < 3.0 * sigma).all()
    image = np.array([float(row["sigma_image_x_mm"]) for row in rows])
    assert (image < 0.02).all()
    assert (sigma[1:, 0] > 3.0 * image[1:]).all()  # the first row is next to the calibration
    assert "abutment_x_mm" not in rows[0]
    assert {row["closure_x_mm"] for row in rows} == {""}
