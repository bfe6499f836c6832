"""Levels and rates are judged by what noise does not explain, with hysteresis and dwell."""

from __future__ import annotations

import numpy as np
import pytest

from core.analysis.alarm_rules import DAY_S, Limits, Samples, fit_rate, judge_level, judge_rate

MINUTE_S = 60.0
LEVEL = Limits(above=10.0, below=-10.0, hysteresis=0.5, sigmas=3.0)


def samples(values: object, sigma: float = 0.1, step_s: float = MINUTE_S) -> Samples:
    value = np.asarray(values, dtype=float)
    return Samples(step_s * np.arange(value.size), value, np.full(value.size, sigma))


def level(values: object, raised: float | None = None, dwell_s: float = 300.0) -> float | None:
    judged = judge_level(samples(values), LEVEL, dwell_s, raised)
    assert judged is not None
    return judged.limit


def test_a_value_is_beyond_only_by_more_than_its_sigmas() -> None:
    assert level([10.25] * 6) is None
    assert level([10.35] * 6) == 10.0
    assert level([-10.25] * 6) is None
    assert level([-10.35] * 6) == -10.0


def test_it_is_over_only_where_it_is_inside_by_the_hysteresis() -> None:
    assert level([9.6] * 6, raised=10.0) == 10.0
    assert level([9.4] * 6, raised=10.0) is None
    assert level([-9.6] * 6, raised=-10.0) == -10.0
    assert level([-9.6] * 6, raised=10.0) is None  # of the other side nothing was raised


def test_one_row_neither_raises_nor_clears() -> None:
    assert level([0.0, 0.0, 50.0, 0.0, 0.0]) is None
    assert level([11.0, 11.0, 0.0, 11.0, 11.0], raised=10.0) == 10.0


def test_rows_before_the_dwell_time_do_not_count() -> None:
    assert level([0.0] * 100 + [11.0] * 5) == 10.0
    assert level([11.0] * 100 + [0.0] * 5, raised=10.0) is None


def test_too_few_rows_say_nothing_and_rows_far_apart_are_three() -> None:
    assert judge_level(samples([11.0, 11.0]), LEVEL, 300.0, None) is None
    hourly = judge_level(samples([0.0, 11.0, 11.0, 11.0], step_s=3600.0), LEVEL, 300.0, None)
    assert hourly is not None
    assert (hourly.rows, hourly.limit) == (3, 10.0)


def daily(days: float, rate: float, seed: int, amplitude: float = 2.0) -> Samples:
    """A row every five minutes: a line, the day's cycle, weather, gaps and noise."""
    random = np.random.default_rng(seed)
    time_s = np.arange(0.0, days * DAY_S, 300.0)
    day = time_s / DAY_S
    value = rate * day + amplitude * np.sin(2 * np.pi * day) + random.normal(0, 0.1, day.size)
    kept = random.random(day.size) > 0.1
    kept &= (day % 1) > 0.15  # a dark part of each night
    return Samples(time_s[kept], value[kept], np.full(int(kept.sum()), 0.1))


def test_the_daily_cycle_is_no_rate_and_its_sigma_is_honest() -> None:
    found = [fit_rate(daily(3, 0.5, seed), 3 * DAY_S) for seed in range(60)]
    errors = np.array([(rate - 0.5) / sigma for rate, sigma in filter(None, found)])
    assert errors.size == 60
    assert abs(errors.mean()) < 0.5
    assert np.mean(np.abs(errors) < 1) > 0.6
    assert np.abs(errors).max() < 4


def test_weather_that_lasts_for_hours_widens_the_sigma() -> None:
    """Correlated scatter, as clouds and wind make it: the white-noise sigma would be far off."""
    errors = []
    for seed in range(60):
        clear = daily(3, 0.0, seed)
        random = np.random.default_rng(seed)
        walk = np.zeros(864)
        for index in range(1, walk.size):
            walk[index] = 0.97 * walk[index - 1] + random.normal(0, 0.1)
        weather = np.interp(clear.time_s, 300.0 * np.arange(walk.size), walk)
        fitted = fit_rate(Samples(clear.time_s, clear.value + weather, clear.sigma), 3 * DAY_S)
        assert fitted is not None
        errors.append(fitted[0] / fitted[1])
    assert np.mean(np.abs(errors) > 3) < 0.05


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rate_beyond_its_limit_is_raised_either_way_and_over_below_the_hysteresis(
    sign: float,
) -> None:
    def judged(rate: float, *, raised: bool = False) -> float | None:
        found = judge_rate(daily(3, sign * rate, 1), 1.0, 0.2, 3.0, 3 * DAY_S, raised=raised)
        assert found is not None
        return found.limit

    assert judged(0.9) is None
    assert judged(1.5) == sign
    assert judged(0.9, raised=True) == sign
    assert judged(0.7, raised=True) is None


def test_a_window_that_is_mostly_missing_says_nothing_of_a_rate() -> None:
    whole = daily(3, 5.0, 1)
    assert judge_rate(whole.since(1.5 * DAY_S), 1.0, 0.2, 3.0, 3 * DAY_S, raised=False) is None
    ends = (whole.time_s < 0.2 * DAY_S) | (whole.time_s > 2.9 * DAY_S)
    few = Samples(whole.time_s[ends], whole.value[ends], whole.sigma[ends])
    assert judge_rate(few, 1.0, 0.2, 3.0, 3 * DAY_S, raised=False) is None
    empty = Samples(np.empty(0), np.empty(0), np.empty(0))
    assert fit_rate(empty, DAY_S) is None
