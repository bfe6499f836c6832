"""What becomes of several pairs of one slot: their robust mean, its sigma, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from core.quality.burst import combine
from core.results import Diagnostics, Displacement, Flag, Measurement, Reason, RigMotion
from tests.exhaustive import one_of

NOISE, SHARED = 0.03, 0.02
SLOTS = 500 // one_of(2)
"""The share of their coordinates within one sigma is known to 0.015; of half as many to 0.021."""
INSECT = Reason.MAIN_TARGET_PARTLY_HIDDEN


def pair(x: float, y: float, *reasons: Reason, shared: float = SHARED) -> Measurement:
    """A pair with a value, its own noise and what all pairs share, both mm."""
    covariance = np.eye(2) * (NOISE**2 + shared**2)
    value = Displacement(np.array([x, y]), covariance, np.eye(2) * shared**2)
    return Measurement(
        Flag.SUSPECT if reasons else Flag.GOOD,
        reasons,
        value,
        Displacement(value.mm + 7.0, covariance, np.eye(2) * shared**2),
        RigMotion(np.array([x, 0.0, 0.0]) * 1e-4, np.array([0.0, y, 0.0]), np.eye(6)),
        Diagnostics(5, 280, 0.01, 0.02),
        frames_used=1,
    )


def without(*reasons: Reason) -> Measurement:
    """A pair without a value."""
    return Measurement(Flag.BAD, reasons, None, None, None)


def scattered(rng: np.random.Generator, n: int, haze_mm: float) -> list[Measurement]:
    """Pairs of a target at rest in haze."""
    off = rng.normal(0.0, np.hypot(NOISE, haze_mm), (n, 2)) + rng.normal(0.0, SHARED, 2)
    return [pair(*xy) for xy in off]


def sigma(measured: Measurement) -> np.ndarray:
    assert measured.corrected is not None
    return np.sqrt(np.diag(measured.corrected.covariance_mm2))


def test_one_pair_is_itself():
    alone = pair(1.0, 2.0)
    assert combine([alone]) is alone


def test_mean_spread_and_number_of_quiet_pairs():
    x = (1.00, 1.02, 0.98, 1.01, 0.99)
    together = combine([pair(v, 2.0) for v in x])
    assert together.flag is Flag.GOOD
    assert together.corrected.mm == pytest.approx([1.0, 2.0])
    assert together.raw.mm == pytest.approx([8.0, 9.0])
    assert together.motion.rotation_rad[0] == pytest.approx(1e-4)
    assert together.spread_mm == pytest.approx([np.std(x, ddof=1), 0.0])
    assert together.frames_used == 5
    assert together.diagnostics == Diagnostics(5, 280, 0.01, 0.02)


@pytest.mark.parametrize("haze_mm", [0.0, 0.05, 0.5])
@pytest.mark.parametrize("n", [2, 3, 5, 12][:: one_of(2)])
def test_sigma_holds_two_thirds_of_the_errors(n, haze_mm):
    rng = np.random.default_rng([n, round(100 * haze_mm)])
    inside = [
        np.abs(m.corrected.mm) < sigma(m)
        for m in (combine(scattered(rng, n, haze_mm)) for _ in range(SLOTS))
    ]
    assert 0.62 < np.mean(inside) < 0.9


def test_image_noise_averages_and_what_all_pairs_share_does_not():
    rng = np.random.default_rng(4)
    many = np.median([sigma(combine(scattered(rng, 30, 0.0))) for _ in range(50)])
    assert many == pytest.approx(np.hypot(NOISE / np.sqrt(30), SHARED), rel=0.15)


def test_haze_widens_sigma():
    rng = np.random.default_rng(5)
    hazy = np.median([sigma(combine(scattered(rng, 9, 0.6))) for _ in range(50)])
    assert hazy == pytest.approx(0.6 / 3.0, rel=0.3)


def test_a_wild_pair_moves_the_mean_by_less_than_the_others_scatter():
    rng = np.random.default_rng(6)
    quiet = scattered(rng, 8, 0.0)
    moved = combine([*quiet, pair(5.0, -5.0)]).corrected.mm - combine(quiet).corrected.mm
    assert np.abs(moved).max() < NOISE


def test_a_bad_pair_does_not_spoil_the_slot():
    together = combine([pair(1.0, 0.0), without(Reason.TOO_DARK), pair(1.0, 0.0)])
    assert (together.flag, together.reasons, together.frames_used) == (Flag.GOOD, (), 2)
    assert together.corrected.mm == pytest.approx([1.0, 0.0])


def test_a_suspect_pair_has_no_say_while_most_are_good():
    together = combine([pair(0.0, 0.0), pair(0.0, 0.0), pair(3.0, 3.0, INSECT)])
    assert together.flag is Flag.GOOD
    assert together.corrected.mm == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize(
    ("pairs", "flag", "reasons"),
    [
        ([pair(0, 0), pair(0, 0, INSECT), pair(0, 0, INSECT)], Flag.SUSPECT, (INSECT,)),
        (
            [pair(0, 0, INSECT, Reason.BLURRED), pair(0, 0, INSECT), pair(0, 0, INSECT)],
            Flag.SUSPECT,
            (INSECT,),
        ),
        (
            [pair(0, 0, INSECT), pair(0, 0, Reason.BLURRED), without(Reason.TOO_DARK)],
            Flag.SUSPECT,
            (INSECT, Reason.BLURRED),
        ),
        (
            [pair(0, 0), without(Reason.TOO_DARK), without(Reason.TOO_DARK)],
            Flag.BAD,
            (Reason.TOO_DARK,),
        ),
        ([without(Reason.MAIN_IMAGE_MISSING)] * 3, Flag.MISSING, (Reason.MAIN_IMAGE_MISSING,)),
    ],
)
def test_most_pairs_decide_and_say_why(
    pairs: Sequence[Measurement], flag: Flag, reasons: tuple[Reason, ...]
):
    together = combine(pairs)
    assert (together.flag, together.reasons) == (flag, reasons)
    assert (together.corrected is None) == (flag in {Flag.BAD, Flag.MISSING})
