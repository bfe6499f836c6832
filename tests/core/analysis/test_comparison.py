"""A record beside a reference: bias, lag and agreement come back as they were made."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.bridges import remembering
from core.analysis.comparison import TimedValues, Zero, compare

DAY_S = 86_400.0
MINUTES = np.arange(0.0, 10 * DAY_S, 600.0)


def wave(times_s: np.ndarray) -> np.ndarray:
    return 2.0 * np.sin(2.0 * np.pi * times_s / DAY_S)


def rows(sigma_mm: float = 0.02, seed: int = 1) -> TimedValues:
    noise = np.random.default_rng(seed).normal(0.0, sigma_mm, len(MINUTES))
    return TimedValues(MINUTES, wave(MINUTES) + noise, np.full(len(MINUTES), sigma_mm))


def survey(times_s: np.ndarray, mm: np.ndarray, sigma_mm: float, seed: int = 2) -> TimedValues:
    noise = np.random.default_rng(seed).normal(0.0, sigma_mm, len(times_s))
    return TimedValues(times_s, mm + noise, np.full(len(times_s), sigma_mm))


TIMES = np.arange(0.5, 9.5, 0.21) * DAY_S


def test_a_free_zero_takes_the_two_systems_zeros_off_and_a_fixed_one_does_not() -> None:
    levelling = survey(TIMES, wave(TIMES) - 3.0, 0.1)
    free = compare(rows(), levelling, window_s=900.0)
    fixed = compare(rows(), levelling, window_s=900.0, zero=Zero.FIXED)
    assert free is not None
    assert fixed is not None
    assert free.agrees
    assert abs(free.offset_mm - 3.0) < 3.0 * free.offset_sigma_mm < 0.1
    assert abs(np.mean([one.difference_mm for one in free.differences])) < 0.01
    assert free.correlation == pytest.approx(0.998, abs=0.002)
    assert fixed.agrees is False
    assert fixed.offset_mm == 0.0
    assert fixed.bias_mm == pytest.approx(free.bias_mm) == pytest.approx(3.0, abs=0.05)
    assert fixed.beyond == len(TIMES)


def test_e_n_is_the_difference_over_both_expanded_uncertainties() -> None:
    ours = TimedValues(np.array([0.0]), np.array([1.0]), np.array([0.03]))
    theirs = TimedValues(np.array([0.0]), np.array([0.9]), np.array([0.04]))
    found = compare(ours, theirs, window_s=1.0, zero=Zero.FIXED)
    assert found is not None
    assert found.largest_e_n == pytest.approx(0.1 / (2.0 * 0.05))
    assert found.agrees
    alone = compare(ours, theirs, window_s=1.0, zero=Zero.FREE)
    assert alone is not None
    assert alone.agrees is None


def test_honest_uncertainties_agree_and_too_small_ones_do_not() -> None:
    """Of 200 comparisons of honest series a few are called different by chance, 1 in 20."""
    verdicts = {1.0: 0, 0.3: 0}
    for seed in range(200):
        levelling = survey(TIMES, wave(TIMES), 0.1, seed)
        for share in verdicts:
            said = TimedValues(TIMES, levelling.values_mm, share * levelling.sigma_mm)
            found = compare(rows(seed=seed + 1000), said, window_s=300.0)
            assert found is not None
            verdicts[share] += bool(found.agrees)
    assert verdicts[1.0] >= 180
    assert verdicts[0.3] == 0


@pytest.mark.parametrize("lag_min", [-95.0, 0.0, 50.0])
def test_a_lag_is_found_within_its_confidence(lag_min: float) -> None:
    within = 0
    for seed in range(10):
        later = survey(TIMES, wave(TIMES - 60.0 * lag_min), 0.1, seed)
        found = compare(rows(), later, window_s=300.0, max_lag_s=4 * 3600.0)
        assert found is not None
        assert found.lag is not None, found.no_lag
        assert found.lag.sigma_s < 360.0
        within += abs(found.lag.lag_s - 60.0 * lag_min) < 2.0 * found.lag.sigma_s
    assert within >= 8


def test_errors_that_last_for_hours_widen_the_lag() -> None:
    """Weather of eight hours beside hourly LiDAR is not as many errors as there are hours."""
    within = 0
    times_s = np.arange(0.5, 9.5, 1.0 / 24.0) * DAY_S
    for seed in range(20):
        weather = remembering(np.random.default_rng(seed), len(MINUTES), 0.1, 48.0)
        ours = rows(seed=seed + 100)
        record = TimedValues(MINUTES, ours.values_mm + weather, ours.sigma_mm)
        found = compare(
            record,
            survey(times_s, wave(times_s - 1800.0), 0.05, seed),
            window_s=300.0,
            max_lag_s=4 * 3600.0,
        )
        assert found is not None
        assert found.lag is not None
        within += abs(found.lag.lag_s - 1800.0) < 2.0 * found.lag.sigma_s
    assert within >= 17


def test_no_lag_is_given_that_the_movement_does_not_show() -> None:
    still = TimedValues(MINUTES, 0.0 * MINUTES, np.full(len(MINUTES), 0.02))
    found = compare(still, survey(TIMES, 0.0 * TIMES, 0.1), window_s=300.0, max_lag_s=3600.0)
    assert found is not None
    assert found.lag is None
    assert "too small" in found.no_lag
    few = compare(rows(), survey(TIMES[:5], wave(TIMES[:5]), 0.1), window_s=300.0, max_lag_s=3600.0)
    assert few is not None
    assert "5 times" in few.no_lag


def test_times_without_a_row_near_are_counted_and_left_out() -> None:
    """A survey in a gap, before and after the record: none of them is compared."""
    ours = rows()
    kept = (ours.times_s < 2 * DAY_S) | (ours.times_s > 5 * DAY_S)
    record = TimedValues(ours.times_s[kept], ours.values_mm[kept], ours.sigma_mm[kept])
    times_s = np.array([-DAY_S, DAY_S, 3 * DAY_S, 6 * DAY_S, 20 * DAY_S])
    found = compare(record, survey(times_s, wave(times_s), 0.1), window_s=600.0)
    assert found is not None
    assert [one.time_s for one in found.differences] == [DAY_S, 6 * DAY_S]
    assert [one.rows for one in found.differences] == [3, 3]
    assert found.unmatched == 3
    assert compare(record, survey(times_s[:1], times_s[:1], 0.1), window_s=600.0) is None
