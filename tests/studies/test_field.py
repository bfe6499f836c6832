"""The field study: the season that its config makes, and what its page says of rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.config.reading import load_config
from drivers.sim.world import World
from studies.field import report
from studies.field_season import Season, slots_between

SEASON = Season("with", plate=True)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    config = load_config(SEASON.write_config(tmp_path_factory.mktemp("field"), 41.0))
    return World(config.site(), config.simulation.settings(), renders=False)


def outcome(world: World, *, lost: int = 0) -> dict[str, Any]:
    """Rows as `run_season` gives them: 0.01 mm off, the night withheld, no power from 45 to 60."""
    rng, rows = np.random.default_rng(1), []
    for slot_utc in slots_between(82_800, SEASON.utc(41.0), SEASON.utc(186.0)):
        truth = world.truth(slot_utc)
        without_power = SEASON.utc(45.0) <= slot_utc < SEASON.utc(60.0)
        flag = "9" if without_power else "4" if "night" in truth.cases else "1"
        if flag == "1" and lost:
            flag, lost = "9", lost - 1
        x_mm, y_mm = truth.displacement_mm + 0.01 * rng.normal(size=2)
        numbers = dict.fromkeys(("raw_x_mm", "raw_y_mm", "tx_mm", "ty_mm", "tz_mm"), "1.0")
        numbers |= dict.fromkeys(("rx_rad", "ry_rad", "rz_rad"), "0.001")
        numbers |= {"x_mm": str(x_mm), "y_mm": str(y_mm), "sigma_x_mm": "0.01"}
        numbers |= {"sigma_y_mm": "0.01"}
        rows.append(
            {
                **(numbers if flag == "1" else dict.fromkeys(numbers, "")),
                "slot_utc": slot_utc.isoformat(),
                "flag": flag,
                "main_c": 20.0,
                "true_mm": truth.displacement_mm.tolist(),
                "cases": list(truth.cases),
            }
        )
    return {"rows": rows, "gaps": {"gaps": []}, "datum": "1 origin"}


def test_the_slab_is_cast_and_creeps_as_in_the_paper(world: World) -> None:
    def level_mm(first: float, end: float) -> float:
        slots = slots_between(3600, SEASON.utc(first), SEASON.utc(end))
        return float(np.mean([world.truth(slot).displacement_mm[1] for slot in slots]))

    assert level_mm(95.3, 96.3) - level_mm(94.0, 95.0) == pytest.approx(-6.5, abs=0.4)
    assert level_mm(185.0, 186.0) - level_mm(95.3, 96.3) == pytest.approx(-8.0, abs=0.4)


def test_events_are_on_their_days(world: World) -> None:
    def cases(day: float) -> tuple[str, ...]:
        return world.truth(SEASON.utc(day)).cases

    assert cases(42.5) == ("glare",)
    assert cases(63.0) == ("night",)
    assert cases(64.9) == ("snow",)
    assert cases(65.9) == ()
    assert [cases(day + 0.5) for day in (173, 178, 183, 184)] == [
        *(("insect_main",), ("insect_sub",), ("insect_main",), ("insect_main",))
    ]


def test_the_page_has_its_columns_and_claims(world: World, tmp_path: Path) -> None:
    made = outcome(world)
    page = report({"without": made, "with": made})
    assert [claim.holds for claim in page.claims] == [True, True, True]
    assert page.tables["errors"].columns[:3] == ("", "rows", "good")
    no_power = next(row for row in page.tables["history"].rows if row[1] == "no power")
    assert no_power[2] == no_power[6] == "16"  # all its slots are missing
    assert page.write(tmp_path) == []


def test_one_powered_lit_slot_without_a_row_is_not_complete(world: World) -> None:
    page = report({"without": outcome(world), "with": outcome(world, lost=1)})
    assert [claim.holds for claim in page.claims] == [True, True, False]
