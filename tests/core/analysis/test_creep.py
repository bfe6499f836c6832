"""Creep of some months predicts later levels, within the interval that is stated."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.bridges import BEGIN_S, CREEP_LAWS, DAY_S, make_creep
from core.analysis.creep import fit_creep
from tests.exhaustive import one_of

SEEDS = range(0, 4, one_of(2))


def test_creep_of_90_days_predicts_a_year_by_whatever_law() -> None:
    """The benchmark holds 200 bridges; here each law once."""
    inside, named = 0, 0
    laws = tuple(enumerate(CREEP_LAWS))[:: one_of(2)]
    for number, law in laws:
        times_s, values_mm, truth = make_creep(law, seed=number)
        found = fit_creep(times_s, values_mm, BEGIN_S, [365.0])
        (prediction,) = found.predictions
        inside += prediction.mm.low <= truth <= prediction.mm.high
        named += found.laws[0].law.value == law
        assert sum(one.probability for one in found.laws) == pytest.approx(1.0)
    assert inside >= len(laws) - len(laws) // 3
    assert named >= len(laws) // 2


def test_creep_that_follows_no_law_is_held_too_and_said_to_depart() -> None:
    """Model Code 2010 is none of the laws: an interval over them alone held none of twelve."""
    inside, departures = 0, []
    for seed in SEEDS:
        times_s, values_mm, truth = make_creep("mc2010", seed)
        found = fit_creep(times_s, values_mm, BEGIN_S, [365.0])
        (prediction,) = found.predictions
        inside += prediction.mm.low <= truth <= prediction.mm.high
        departures.append(found.departure)
    assert inside >= len(SEEDS) - 1
    assert sorted(departures)[1] >= 0.02  # one may look like a law in 90 days


def test_both_curves_of_a_law_go_one_way() -> None:
    """Creep that turns back is not explained by a quick sagging and a slow rising."""
    rng = np.random.default_rng(4)
    days = np.arange(2400) / 24.0
    values_mm = 4.0 * -np.expm1(-days / 5.0) + 3.0 * np.expm1(-days / 100.0)
    values_mm += 0.05 * rng.normal(size=len(days))
    found = fit_creep(BEGIN_S + days * DAY_S, values_mm, BEGIN_S, [365.0])
    for one in found.laws:
        assert min(one.sizes_mm) * max(one.sizes_mm) >= 0.0, one.law


def test_creep_is_known_as_closely_as_the_means_of_days_show_it() -> None:
    """White noise of 0.2 mm an hour is 0.04 mm a day; taken for 0.2 mm the interval is 1.4 mm."""
    days = np.arange(2160) / 24.0
    inside, widths = 0, []
    for seed in SEEDS:
        noise_mm = 0.2 * np.random.default_rng(seed).normal(size=len(days))
        values_mm = 1.2 * days**0.4 + noise_mm
        found = fit_creep(BEGIN_S + days * DAY_S, values_mm, BEGIN_S, [365.0])
        (level,) = found.predictions
        inside += level.mm.low <= 1.2 * 365.0**0.4 <= level.mm.high
        widths.append(level.mm.high - level.mm.low)
    assert inside >= len(SEEDS) - 1
    assert np.median(widths) < 0.8


def test_the_level_predicted_is_that_at_the_mean_temperature_of_the_hours() -> None:
    """A warming record: neither its first days nor its last are the mean."""
    days = np.arange(2160) / 24.0
    warm = np.column_stack([days / 9.0 + np.sin(days / 3.0)])
    rng = np.random.default_rng(5)
    creep_mm = 2.0 * np.log1p(days / 2.0)
    values_mm = creep_mm + 0.5 * warm[:, 0] + 0.02 * rng.normal(size=len(days))
    found = fit_creep(BEGIN_S + days * DAY_S, values_mm, BEGIN_S, [60.0], warm)
    (level,) = found.predictions
    assert level.mm.value == pytest.approx(2.0 * np.log(31.0) + 0.5 * warm.mean(), abs=0.05)


def test_creep_of_a_few_days_is_refused_in_words() -> None:
    times_s, values_mm, _ = make_creep("power", seed=1)
    few = times_s < BEGIN_S + 5.0 * DAY_S
    with pytest.raises(ValueError, match="too short"):
        fit_creep(times_s[few], values_mm[few], BEGIN_S, [365.0])
