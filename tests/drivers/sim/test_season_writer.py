"""A season made by the simulation: calibrations months apart, and a truth that spans them."""

from __future__ import annotations

import csv
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from core.site import CirclesTarget, ExtraTarget, TargetRole
from drivers.frameset import read_frame_set
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.season_writer import Season, SeasonPlan, measure_slots, write_season
from drivers.sim.settings import Breathing, Climate, SimPlate, SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import CENTRES_MM, site

PLATE = ExtraTarget(
    "abutment", TargetRole.FIXED, CirclesTarget(CENTRES_MM, np.full(5, 8.0), 22250.0, 20.0)
)
PLACE = site(shrink=8, distance_mm=22000.0, extra_targets=(PLATE,))
SETTINGS = SimSettings(
    climate=Climate(air_daily_k=5.0, air_seasonal_k=12.0, air_weather_k=2.0),
    breathing=Breathing(
        cameras_urad_per_k=(2.0, 2.0, 1.0),
        cameras_urad_per_sqrt_day=(1.7, 1.7, 0.5),
        main_px_per_k=(0.02, 0.02),
    ),
    plates=(SimPlate("abutment", hidden_min=((1440.0 * 100, 1440.0 * 200),)),),
)
PLAN = SeasonPlan(measure=(4, 3), intrinsics=2, rig=2, refocused=("sub",))


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Season:
    return write_season(tmp_path_factory.mktemp("season"), PLACE, SETTINGS, PLAN)


def _truth(directory: Path) -> list[dict[str, str]]:
    with (directory / "truth.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def _numbers(row: dict[str, str], *columns: str) -> list[float]:
    return [float(row[column]) for column in columns]


def test_both_parts_read_as_frame_sets(season: Season) -> None:
    """Each has its calibration and then its measure rows; the second follows the first in time."""
    first, second = (read_frame_set(directory) for directory in season.parts)
    calibrated = ["intrinsics"] * 2 + ["reference"] + ["rig"] * 2
    assert [row.role for row in first.rows] == calibrated + ["measure"] * 4
    assert [row.role for row in second.rows] == calibrated + ["measure"] * 3
    assert [directory.name for directory in season.parts] == ["first", "second"]
    assert first.rows[-1].slot_utc < second.rows[0].slot_utc
    assert second.rows[-1].slot_utc - first.rows[0].slot_utc > timedelta(days=120)
    assert first.read(first.rows[-1].main).pixels.shape == (150, 240)


def test_frames_tell_the_cameras_temperatures(season: Season) -> None:
    """As the cameras report them; a lens view has none of the main camera."""
    for directory in season.parts:
        rows = read_frame_set(directory).rows_of("reference", "measure")
        said = [(row.main_temperature_c, row.sub_temperature_c) for row in rows]
        columns = "temperature_main_c", "temperature_sub_c"
        true = [_numbers(row, *columns) for row in _truth(directory)]
        assert np.array(said) == pytest.approx(np.array(true), abs=6e-3)
    lens_view = read_frame_set(season.parts[0]).rows[0]
    assert lens_view.main_temperature_c is None
    assert lens_view.sub_temperature_c is not None
    warm = [float(row["temperature_main_c"]) for part in season.parts for row in _truth(part)]
    assert np.ptp(warm) > 10.0


def test_the_second_calibration_is_the_moment_of_the_last_row_before(season: Season) -> None:
    """Target, plate and rig stand as then; board and lens do not: the sub image is another."""
    first, second = (_truth(directory) for directory in season.parts)
    last, reference = first[-1], second[0]
    assert reference["role"] == "reference"
    columns = last.keys() - {"slot_utc", "role", "case", "abutment_case"}
    assert _numbers(reference, *columns) == pytest.approx(_numbers(last, *columns), abs=1e-8)
    assert abs(float(reference["y_mm"])) > 0.5
    sets = [read_frame_set(directory) for directory in season.parts]
    images = [sets[0].rows[-1], sets[1].rows_of("reference")[0]]
    sub = [
        frames.read(row.sub).pixels.astype(int) for frames, row in zip(sets, images, strict=True)
    ]
    main = [
        frames.read(row.main).pixels.astype(int) for frames, row in zip(sets, images, strict=True)
    ]
    assert np.abs(sub[1] - sub[0]).max() > 60
    assert np.abs(main[1] - main[0]).max() < 25


def test_truth_counts_from_the_first_reference_and_tells_breath_and_plates(season: Season) -> None:
    """truth.csv has what a world of the same settings says, and when the plate is hidden."""
    world = World(PLACE, SETTINGS, renders=False)
    rows = [row for directory in season.parts for row in _truth(directory)]
    assert _numbers(rows[0], "x_mm", "y_mm", "shift_u_px", "shift_v_px") == pytest.approx([0.0] * 4)
    for frames, row in ((read_frame_set(p), r) for p in season.parts for r in _truth(p)):
        if row["role"] != "measure":
            continue
        slot = next(
            f.slot_utc for f in frames.rows if f"{f.slot_utc:%Y-%m-%dT%H:%M:%SZ}" == row["slot_utc"]
        )
        truth = world.truth(slot)
        assert _numbers(row, "x_mm", "y_mm") == list(truth.displacement_mm)
        assert _numbers(row, "shift_u_px", "shift_v_px") == pytest.approx(truth.shift_px)
        plate = truth.plates["abutment"]
        assert _numbers(row, "abutment_x_mm", "abutment_y_mm") == list(plate.displacement_mm)
        assert _numbers(row, "abutment_shift_u_px") == pytest.approx(plate.shift_px[:1])
        assert row["abutment_case"] == ("hidden" if plate.hidden else "ok")
    assert {row["abutment_case"] for row in rows} == {"hidden", "ok"}


def test_a_set_that_does_not_breathe_has_no_such_columns(tmp_path: Path) -> None:
    """Neither temperatures beside its frames nor breath beside its truth."""
    plan = FrameSetPlan(intrinsics=0, rig=0, measure=1)
    write_frame_set(tmp_path, site(shrink=24), SimSettings(), plan)
    assert read_frame_set(tmp_path).rows[0].extra == {}
    assert list(_truth(tmp_path)[0])[-1] == "tz_mm"


def test_rows_are_spread_over_the_season_and_the_day() -> None:
    """In order, to whole minutes, at all hours, however long the season."""
    for days, count in ((145.0, 40), (2.0, 8), (3650.0, 300)):
        slots = measure_slots(SETTINGS.start_utc, SeasonPlan(days=days, measure=(count,)))
        assert slots == sorted(set(slots))
        assert slots[0] == SETTINGS.start_utc
        assert 0.8 * days < (slots[-1] - slots[0]) / timedelta(days=1) < days
        if days > count:
            assert len({slot.hour // 4 for slot in slots}) == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measure": ()}, "give 1 to 4 parts"),
        ({"measure": (3, 0)}, "none empty"),
        ({"days": 1.0, "measure": (20, 20)}, "no time to calibrate"),
    ],
)
def test_a_plan_that_does_not_work_out_is_refused(changes: dict[str, object], message: str) -> None:
    """The error says what to give."""
    with pytest.raises(ValueError, match=message):
        SeasonPlan(**changes)
