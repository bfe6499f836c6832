"""A frame set made by the simulation is one that users could have taken, with its truth beside."""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from drivers.frameset import read_frame_set
from drivers.sim.frameset_writer import FrameSetPlan, head_reach_deg, write_frame_set
from drivers.sim.settings import Scenario, SimSettings
from tests.drivers.sim.rigs import site

PLAN = FrameSetPlan(intrinsics=2, rig=3, measure=4)
START = SimSettings().start_utc


def _truth(directory: Path) -> list[dict[str, str]]:
    with (directory / "truth.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_set_reads_back(tmp_path: Path) -> None:
    """All roles in time order; every image named is there, right in size and bits."""
    settings = replace(SimSettings(), sensor=replace(SimSettings().sensor, bits=12))
    made = write_frame_set(tmp_path, site(shrink=8), settings, PLAN)
    frames = read_frame_set(tmp_path)
    roles = [row.role for row in frames.rows]
    assert roles == ["intrinsics"] * 2 + ["reference"] + ["rig"] * 3 + ["measure"] * 4
    assert frames.rows_of("measure")[0].slot_utc == START
    assert [row.main is None for row in frames.rows] == [True] * 2 + [False] * 8
    for row in frames.rows_of("reference", "rig", "measure"):
        for name in (row.main, row.sub):
            image = frames.read(name)
            assert image.pixels.shape == (150, 240)
            assert image.bits == 12
    last = frames.rows[-1]
    assert np.array_equal(frames.read(last.sub).pixels, made.render("sub", last.slot_utc))


def test_truth_stands_beside(tmp_path: Path) -> None:
    """truth.csv has the reference at zero and what the world says of each measure row."""
    settings = SimSettings(
        scenarios=(Scenario("drift"), Scenario("bridge"), Scenario("night", 170))
    )
    made = write_frame_set(tmp_path, site(shrink=8), settings, PLAN)
    reference, *measures = _truth(tmp_path)
    assert reference["role"] == "reference"
    assert float(reference["x_mm"]) == pytest.approx(0.0, abs=1e-12)
    assert float(reference["false_y_mm"]) == pytest.approx(0.0, abs=1e-9)
    assert [row["case"] for row in measures] == ["ok", "ok", "ok", "night"]
    truth = made.truth(START + timedelta(minutes=120))
    row = measures[2]
    assert [float(row["x_mm"]), float(row["y_mm"])] == list(truth.displacement_mm)
    assert [float(row["false_x_mm"]), float(row["false_y_mm"])] == list(truth.false_mm)
    assert [float(row[k]) for k in ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")] == (
        list(truth.motion.vector)
    )
    assert abs(float(row["y_mm"])) > 0.5


@pytest.mark.parametrize("distance_mm", [11000.0, 22000.0])
def test_head_keeps_all_discs_in_view(tmp_path: Path, distance_mm: float) -> None:
    """Rig positions use the field of view and lose no disc, at any distance."""
    place = site(shrink=8, distance_mm=distance_mm)
    plan = FrameSetPlan(intrinsics=0, rig=8, measure=3, moved_by="head")
    world = write_frame_set(tmp_path, place, SimSettings(scenarios=()), plan)
    false = [[float(row["false_x_mm"]), float(row["false_y_mm"])] for row in _truth(tmp_path)]
    assert np.ptp(false, axis=0).max() > 0.001 * distance_mm
    assert all(row.pan_deg is None for row in read_frame_set(tmp_path).rows_of("measure"))
    pan_deg, tilt_deg = head_reach_deg(place)
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        world.turn_head(0.8 * signs[0] * pan_deg, 0.8 * signs[1] * tilt_deg)
        centres = world.disc_centres_px(START)
        assert np.all(centres > 3.0)
        assert np.all(centres < np.array([240, 150]) - 4.0)


def test_a_lost_camera_leaves_its_cell_empty(tmp_path: Path) -> None:
    """A measure row without the lost camera's image is a row all the same."""
    settings = SimSettings(scenarios=(Scenario("camera_loss", 50, 130, role="main"),))
    write_frame_set(tmp_path, site(shrink=8), settings, PLAN)
    rows = read_frame_set(tmp_path).rows_of("measure")
    assert [row.main is None for row in rows] == [False, True, True, False]
    assert all(row.sub for row in rows)
