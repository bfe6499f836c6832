"""A thermometer's noise and slots an hour apart leave mm/K and lag within their intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bridges import Bridge, make, remembering
from core.analysis.binning import hours_of
from core.analysis.reading_course import Structure, estimated
from core.analysis.thermal import Response, temperature_response

QUIET = Bridge(days=45.0, white_mm=0.01, fast_mm=0.002, slow_mm=0.002, outages=0.0, lost=0.0)


def response_of(bridge: Bridge, seed: int) -> Response:
    """Of the one mass that such a bridge has."""
    made = make(bridge, seed)
    found = temperature_response(hours_of(made.times_s, made.y_mm, made.deck_c[:, None]), (0,))
    assert found is not None
    (response,) = found.responses
    return response


def test_slots_an_hour_apart_do_not_make_a_bridge_softer() -> None:
    """A row is no mean of its hour: taken for one, 0.25 mm/K came out 0.3 % and more too large."""
    off = []
    for seed in range(4):
        bridge = replace(QUIET, days=60.0, every=60, sensor_k=0.0, sensor_h=1.0, lag_h=1.5)
        size = response_of(bridge, seed).mm_per_unit
        assert size.low <= 0.25 <= size.high
        off.append(size.value / 0.25 - 1.0)
    assert abs(np.mean(off)) < 0.001


@pytest.mark.parametrize("sensor_k", [0.0, 0.3, 1.0])
def test_a_thermometer_of_much_noise_gives_the_size_as_one_of_none(sensor_k: float) -> None:
    """Of 1 K in rows of ten minutes the noise itself was once fitted, as two masses."""
    off = []
    for seed in range(3):
        bridge = replace(QUIET, every=10, sensor_k=sensor_k, sensor_h=1.0)
        off.append(response_of(bridge, seed).mm_per_unit.value / 0.25 - 1.0)
    assert np.max(np.abs(off)) < 0.002 + 0.015 * sensor_k
    assert abs(np.mean(off)) < 0.001 + 0.008 * sensor_k


def smooth_values(rng: np.random.Generator) -> np.ndarray:
    """Thirty days of ten minutes each: the day's cycle and weather."""
    places = np.arange(30 * 144)
    return 6.0 * np.sin(2.0 * np.pi * places / 144.0) + remembering(rng, len(places), 3.0, 400.0)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_the_noise_of_a_thermometer_shows_in_its_own_values(noise: float) -> None:
    rng = np.random.default_rng(1)
    values = smooth_values(rng)
    values += noise * rng.normal(size=len(values))
    values[rng.random(len(values)) < 0.2] = np.nan
    found = Structure.of(values)
    assert found is not None
    assert np.sqrt(found.noise) == pytest.approx(noise, abs=0.05)


def test_a_reading_between_hourly_slots_is_that_of_its_day() -> None:
    """Straight lines would cut a hundredth off the cycle; what is left of the error is weather."""
    values = smooth_values(np.random.default_rng(2))
    seen = np.where(np.arange(len(values)) % 6 == 0, values, np.nan)
    found = estimated(seen, np.ones(len(values), np.bool_))
    between = np.isnan(seen)
    cycle = np.sin(2.0 * np.pi * np.arange(len(values)) / 144.0)
    wrong = (found - values)[between]
    assert abs(np.sum(wrong * cycle[between]) / np.sum(cycle[between] ** 2)) < 0.01
    assert np.std(wrong) < 0.35
    noisy = values + 0.5 * np.random.default_rng(3).normal(size=len(values))
    assert np.std(estimated(noisy, between | ~between) - values) < 0.35


def test_what_says_nothing_of_itself_is_left_as_it_is() -> None:
    few = np.full(200, np.nan)
    few[[3, 90]] = 1.0
    everywhere = np.ones(200, np.bool_)
    assert np.array_equal(estimated(few, everywhere), few, equal_nan=True)
    assert np.array_equal(estimated(np.full(200, 7.0), everywhere), np.full(200, 7.0))
