"""Which temperature counts for what: lenses follow the camera, steel and board a sensor."""

from __future__ import annotations

from dataclasses import replace

import pytest

from core.moment import Moment
from core.rig.stability import stability_terms
from core.site import StabilityBudget
from tests.core.scenes import small_site

SITE = replace(small_site(22000.0), stability=StabilityBudget(), temperature_reading="steel")
COLD, WARM = Moment(0.0, 30.0, {"steel": 5.0, "air": 9.0}), Moment(3600.0, 32.0, {"steel": 25.0})


def kelvin(reference: Moment, now: Moment, sensor: str | None = "steel") -> tuple[str, str]:
    """What the terms say of steel and of the main lens."""
    site = replace(SITE, temperature_reading=sensor)
    terms = stability_terms(site, site.nominal_px_per_mm, reference, now)
    said = [term.name for term in terms]
    steel = next(name for name in said if name.startswith("the cameras turning against each other"))
    lens = next(name for name in said if name.startswith("the main lens"))
    assert any(name == f"the board expanding over {steel.split(' over ')[1]}" for name in said)
    return steel.split(" over ")[1], lens.split(" by ")[1]


def test_steel_and_board_follow_the_sensor_that_the_site_names() -> None:
    assert kelvin(COLD, WARM) == ("20.0 K", "2.0 K")


def test_without_a_named_sensor_the_camera_tells_for_all() -> None:
    assert kelvin(COLD, WARM, None) == ("2.0 K", "2.0 K")


def test_a_sensor_that_has_no_value_at_one_of_both_times_is_replaced_by_the_camera() -> None:
    assert kelvin(COLD, WARM, "air") == ("2.0 K", "2.0 K")
    assert kelvin(replace(COLD, readings={}), WARM) == ("2.0 K", "2.0 K")


def test_where_no_camera_tells_the_sensor_stands_for_it() -> None:
    assert kelvin(replace(COLD, temperature_c=None), WARM) == ("20.0 K", "20.0 K")


def test_a_moment_keeps_what_the_sensors_said() -> None:
    assert Moment.from_dict(COLD.to_dict()) == COLD
    assert Moment.from_dict({"utc_s": 1, "temperature_c": None}) == Moment(1.0)


def test_the_sigma_of_a_row_follows_the_sensor() -> None:
    def sigma_mm(sensor: str | None) -> float:
        site = replace(SITE, temperature_reading=sensor)
        terms = stability_terms(site, 10.0, COLD, WARM)
        return float(sum(term.sigma_mm(10.0) ** 2 for term in terms)) ** 0.5

    # 1.5 and 0.5 urad/K over 20 K at 22 m, beside 2 K by the camera.
    assert sigma_mm("steel") == pytest.approx(0.70, abs=0.05)
    assert sigma_mm(None) < 0.15
