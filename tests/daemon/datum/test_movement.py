"""How far a bridge moves in a gap, as its record shows it: in mm, against what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.datum.movement import drift_sigma_mm, movement_sigma_mm

MINUTE_S = 60.0


def test_a_wandering_bridge_moves_with_the_root_of_the_gap() -> None:
    rng = np.random.default_rng(1)
    mm = np.cumsum(rng.normal(0.0, 0.01, (20_000, 2)), axis=0)
    times_s = MINUTE_S * np.arange(len(mm))
    for minutes in (1, 100, 1000):
        sigma_mm = movement_sigma_mm(times_s, mm, minutes * MINUTE_S)
        assert sigma_mm == pytest.approx([0.01 * minutes**0.5] * 2, rel=0.4)


def test_a_gap_longer_than_the_record_costs_its_spread() -> None:
    mm = np.random.default_rng(2).normal(0.0, 2.0, (500, 2))
    times_s = MINUTE_S * np.arange(500)
    sigma_mm = movement_sigma_mm(times_s, mm, 40 * 86_400.0)
    assert sigma_mm == pytest.approx([2.0 * 2**0.5] * 2, rel=0.15)


def test_rows_weeks_apart_bound_a_gap_of_an_hour() -> None:
    days = np.arange(8) * 14.0
    mm = np.column_stack([np.zeros(8), np.array([0.0, 1.8, 3.3, 4.2, 4.5, 4.1, 3.4, 2.8])])
    sigma_mm = movement_sigma_mm(86_400.0 * days, mm, 3600.0)
    assert sigma_mm is not None
    assert 0.5 < sigma_mm[1] < 1.5


def test_outliers_do_not_widen_it() -> None:
    rng = np.random.default_rng(3)
    mm = rng.normal(0.0, 0.1, (2000, 2))
    mm[::50] += 30.0
    sigma_mm = movement_sigma_mm(MINUTE_S * np.arange(2000), mm, 10 * MINUTE_S)
    assert sigma_mm == pytest.approx([0.1 * 2**0.5] * 2, rel=0.15)


def test_a_few_rows_tell_nothing() -> None:
    assert movement_sigma_mm(np.arange(3.0), np.zeros((3, 2)), 60.0) is None


def test_no_gap_at_all_is_a_second() -> None:
    mm = np.random.default_rng(4).normal(0.0, 0.1, (100, 2))
    assert movement_sigma_mm(np.arange(100.0), mm, 0.0) is not None


def test_a_rig_that_follows_the_clouds_moves_within_an_hour() -> None:
    """A row a minute shows it; rows days apart show where it can be, of which an hour is a part."""
    rng = np.random.default_rng(5)
    share = np.exp(-1.0 / 240.0)
    mm = np.zeros((40_000, 3))
    for k, step in enumerate(rng.normal(0.0, 0.4 * (1.0 - share**2) ** 0.5, (39_999, 3))):
        mm[k + 1] = share * mm[k] + step
    times_s = MINUTE_S * np.arange(len(mm))
    true_mm = np.sqrt(((mm[60:] - mm[:-60]) ** 2).mean(axis=0))
    assert true_mm == pytest.approx([0.27] * 3, rel=0.1)
    dense = drift_sigma_mm(times_s, mm, 3600.0)
    sparse = drift_sigma_mm(times_s[::2880], mm[::2880], 3600.0)
    assert dense is not None
    assert sparse is not None
    assert dense == pytest.approx(true_mm, rel=0.1)
    assert sparse.mean() == pytest.approx(true_mm.mean(), rel=0.4)
    assert drift_sigma_mm(times_s[:3], mm[:3], 3600.0) is None
