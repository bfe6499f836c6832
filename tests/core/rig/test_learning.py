"""What the record of a fixed target tells of the rig: known coefficients are found again."""

from __future__ import annotations

import numpy as np
import pytest

from core.arrays import FloatArray
from core.rig.learning import RigFit, TargetHours, fit_rig, low_passed
from tests.exhaustive import one_of

NEAR_MM, FAR_MM = 11_000.0, 22_000.0
C_URAD_PER_K = np.array([1.8, -0.9])
CREEP_URAD = 1.2
AIR_URAD_PER_M = 0.465
"""Of a gradient of 1 K/m."""


def hours(
    seed: int,
    days: int = 40,
    *,
    distances_mm: tuple[float, ...] = (FAR_MM,),
    lag_h: float = 0.0,
    air_k_per_m: float = 0.0,
    calibrations: int = 1,
) -> TargetHours:
    """A rig that turns with warmth and creeps, watched hour by hour."""
    rng = np.random.default_rng(seed)
    n = 24 * days
    t = np.tile((np.arange(n) + 0.5) / 24.0, calibrations)
    which = np.repeat(np.arange(calibrations), n)
    wave = np.sin(2.0 * np.pi * (t - 0.4))
    weather = np.concatenate([np.cumsum(rng.normal(0.0, 0.4, n)) for _ in range(calibrations)])
    warmth_k = 10.0 + 5.0 * wave + weather
    steel_k = low_passed(which, t, warmth_k, lag_h)
    walk = np.concatenate(
        [
            np.cumsum(rng.normal(0.0, CREEP_URAD / 24**0.5, (n, 2)), axis=0)
            for _ in range(calibrations)
        ]
    )
    turn_urad = C_URAD_PER_K * (steel_k - 10.0)[:, None] + walk + 3.0 * which[:, None]
    gradient = np.where(rng.random(len(t)) < 0.5, 1.0, -1.0) * air_k_per_m
    bent = AIR_URAD_PER_M * gradient[:, None] * np.array(distances_mm) * 1e-3
    urad = turn_urad[:, None, :] + np.stack([0.0 * bent, bent], axis=2)
    mm = 1e-6 * urad * np.array(distances_mm)[:, None]
    noise_mm = 0.004
    mm += rng.normal(0.0, noise_mm, mm.shape)
    noise_mm2 = np.full(mm.shape, noise_mm**2)
    return TargetHours(which, t, warmth_k, mm, noise_mm2, np.array(distances_mm))


def misses(fit: RigFit) -> FloatArray:
    """Errors of the coefficients over their sigmas."""
    return np.array(
        [
            (axis.urad_per_k.value - c) / axis.urad_per_k.sigma
            for axis, c in zip(fit.axes, C_URAD_PER_K, strict=True)
        ]
    )


def test_coefficients_and_creep_are_found_and_their_sigmas_are_true() -> None:
    fits = [fit_rig(hours(seed)) for seed in range(0, 12, one_of(3))]
    missed = np.concatenate([misses(fit) for fit in fits])
    assert 0.45 < np.mean(np.abs(missed) < 1.0) < 0.9
    assert np.abs(missed).max() < 4.0
    for fit in fits:
        for axis, c in zip(fit.axes, C_URAD_PER_K, strict=True):
            assert axis.urad_per_k.value == pytest.approx(c, abs=0.2 * abs(c))
    creep = np.array([axis.urad_per_sqrt_day.value for fit in fits for axis in fit.axes])
    sigma = np.array([axis.urad_per_sqrt_day.sigma for fit in fits for axis in fit.axes])
    assert np.sqrt((((creep - CREEP_URAD) / sigma) ** 2).mean()) < 1.6
    assert creep.mean() == pytest.approx(CREEP_URAD, rel=0.1)


def test_several_calibrations_tell_more_than_each() -> None:
    one, three = fit_rig(hours(1, 15)), fit_rig(hours(1, 15, calibrations=3))
    assert np.abs(misses(three)).max() < 4.0
    for axis in (0, 1):
        assert three.axes[axis].urad_per_k.sigma < 0.8 * one.axes[axis].urad_per_k.sigma


def test_steel_that_follows_slowly_is_noticed() -> None:
    assert fit_rig(hours(2)).lag_h == 0.0
    slow = fit_rig(hours(2, lag_h=4.0))
    assert slow.lag_h == 4.0
    assert np.abs(misses(slow)).max() < 4.0


def test_a_rig_that_rests_has_no_coefficient_and_little_creep() -> None:
    resting = hours(4)
    rng = np.random.default_rng(4)
    mm = rng.normal(0.0, 0.004, resting.mm.shape)
    still = TargetHours(
        resting.calibration,
        resting.days,
        resting.warmth_k,
        mm,
        resting.noise_mm2,
        resting.distance_mm,
    )
    fit = fit_rig(still)
    assert fit.urad_per_k.value < 0.02
    assert fit.urad_per_sqrt_day.value < 0.1


def test_two_distances_tell_the_air_from_the_steel() -> None:
    fit = fit_rig(hours(3, distances_mm=(NEAR_MM, FAR_MM), air_k_per_m=0.5))
    assert fit.air_k_per_m is not None
    assert fit.air_k_per_m.value == pytest.approx(0.5, rel=0.05)
    assert np.abs(misses(fit)).max() < 4.0
    assert fit_rig(hours(3, air_k_per_m=0.5)).air_k_per_m is None
