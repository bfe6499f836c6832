"""The law of exposure: gets there, stays there, and is not led astray by what is no light."""

from __future__ import annotations

import math

import pytest

from core.exposure.exposure_rule import PATIENCE_SLOTS, Exposure, ExposureRule, next_exposure
from core.exposure.target_light import TargetLight

RULE = ExposureRule(Exposure(5000.0, 0.0), 50.0, 100_000.0, 0.0, 12.0)
WHOLE_RANGE_SLOTS = 8
"""From one end of the ordinary limits to the other, and settled."""


def seen(light: float, exposure: Exposure, reflectance: float = 0.75) -> TargetLight:
    """A target under so much light, 1 being right for the start."""
    gain = 10.0 ** ((exposure.gain_db or 0.0) / 20.0)
    gathered = light * gain * exposure.time_us / RULE.start.time_us
    white, black = (min(share * gathered + 0.01, 1.0) for share in (reflectance, 0.05))
    return TargetLight(white, black, float(white == 1.0))


def followed(
    light: float, exposure: Exposure, slots: int, rule: ExposureRule = RULE
) -> list[Exposure]:
    """The exposures of so many slots under the same light."""
    exposures = []
    for _ in range(slots):
        exposure = next_exposure(exposure, rule, seen(light, exposure))
        exposures.append(exposure)
    return exposures


def amount(exposure: Exposure) -> float:
    return exposure.time_us * 10.0 ** ((exposure.gain_db or 0.0) / 20.0)


@pytest.mark.parametrize("begin", [Exposure(50.0, 0.0), RULE.start, Exposure(100_000.0, 12.0)])
@pytest.mark.parametrize("light", [0.01, 0.02, 0.1, 0.7, 1.0, 3.0, 30.0, 80.0])
def test_any_light_is_met_within_eight_slots_and_then_left_alone(
    light: float, begin: Exposure
) -> None:
    """From either end of the limits: settled near the wanted level, and no swinging after it."""
    exposures = followed(light, begin, 20)
    settled = exposures[WHOLE_RANGE_SLOTS - 1]
    assert exposures[WHOLE_RANGE_SLOTS:] == [settled] * 12
    assert seen(light, settled).white == pytest.approx(RULE.white, rel=0.3)
    amounts = [amount(exposure) for exposure in exposures]
    if begin.time_us == RULE.least_us:
        assert max(amounts) < 1.3 * amounts[-1]
    if begin.time_us == RULE.most_us:  # saturated: how far down is only known once it is not
        assert min(amounts) > amounts[-1] / 4.0


def test_clouds_within_a_fifth_change_nothing() -> None:
    exposure = followed(0.3, RULE.start, 5)[-1]
    for light in (0.25, 0.36, 0.28, 0.35):
        assert next_exposure(exposure, RULE, seen(light, exposure)) == exposure


def test_exposure_is_lengthened_before_gain_and_gain_lowered_before_exposure() -> None:
    up = followed(0.02, Exposure(1000.0, 0.0), 10)
    assert all(e.gain_db == 0.0 or e.time_us == RULE.most_us for e in up)
    assert (up[-1].time_us, up[-1].gain_db) == (RULE.most_us, pytest.approx(7.0, abs=2.5))
    down = followed(1.0, up[-1], 10)
    assert all(e.gain_db == 0.0 or e.time_us == RULE.most_us for e in down)
    assert down[-1].gain_db == 0.0
    assert down[-1].time_us < 7000.0


@pytest.mark.parametrize(("light", "end"), [(1e-4, (100_000.0, 12.0)), (1e4, (50.0, 0.0))])
def test_light_beyond_all_reach_ends_at_the_limits(light: float, end: tuple[float, float]) -> None:
    exposures = followed(light, RULE.start, 20)
    assert (exposures[-1].time_us, exposures[-1].gain_db) == end
    assert all(RULE.least_us <= e.time_us <= RULE.most_us for e in exposures)
    assert all(RULE.least_db <= (e.gain_db or 0.0) <= RULE.most_db for e in exposures)


def test_a_camera_without_gain_is_led_by_exposure_alone() -> None:
    exposures = followed(0.01, Exposure(5000.0, None), 10)
    assert (exposures[-1].time_us, exposures[-1].gain_db) == (100_000.0, None)


def test_a_saturated_target_is_pulled_down_at_once_by_four() -> None:
    after = next_exposure(RULE.start, RULE, TargetLight(0.9, 0.3, 0.4))
    assert amount(after) == pytest.approx(RULE.start.time_us / 4.0, rel=0.01)


def lost(white: float, exposure: Exposure, slots: int) -> list[Exposure]:
    """Exposures while the target is hidden by something of this white at the start exposure."""
    exposures = []
    for slot in range(slots):
        light = seen(1.0, exposure, reflectance=white)
        exposure = next_exposure(exposure, RULE, light, slot + 1)
        exposures.append(exposure)
    return exposures


def test_a_hidden_target_leaves_exposure_where_it_is_and_later_at_its_start() -> None:
    """A lorry before the target at noon, exposure being short: waits, then returns in steps."""
    short = Exposure(2000.0, 0.0)
    exposures = lost(0.5, short, PATIENCE_SLOTS + 10)
    assert exposures[:PATIENCE_SLOTS] == [short] * PATIENCE_SLOTS
    assert amount(exposures[-1]) == pytest.approx(RULE.start.time_us, rel=0.3)


@pytest.mark.parametrize("white", [1e-4, 0.003, 0.02, 0.08, 0.2, 0.5, 2.0, 30.0])
@pytest.mark.parametrize("begin", [Exposure(50.0, 0.0), RULE.start, Exposure(100_000.0, 12.0)])
def test_a_lost_target_never_makes_exposure_run_away_or_swing(
    white: float, begin: Exposure
) -> None:
    """Whatever is in its place, dark or bright: within the limits, and at rest in the end."""
    exposures = lost(white, begin, 60)
    assert exposures[30:] == [exposures[30]] * 30
    area = seen(1.0, exposures[-1], reflectance=white).white
    at_limit = exposures[-1] in (Exposure(100_000.0, 12.0), Exposure(50.0, 0.0))
    assert at_limit or 0.15 <= area < 0.98
    reach = amount(exposures[-1]) / RULE.start.time_us
    if 0.3 < white < 0.9:
        assert abs(math.log(reach)) < 0.3


def test_a_target_too_dark_to_be_found_is_found_again() -> None:
    """Lamps go out in the middle of the day: without the target, its area leads up."""
    exposure, slots = RULE.start, 0
    while seen(0.02, exposure).white < 0.25:
        slots += 1
        exposure = next_exposure(exposure, RULE, seen(0.02, exposure), slots)
    assert slots <= 2
