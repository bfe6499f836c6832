"""What fixed targets show is taken off the others, and the sigma says what is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.discs.disc_finder import Discs
from core.moment import Moment
from core.rig.calibrated_target import CalibratedTarget
from core.rig.closure import JointShifts, close, closure_of, consistent, is_beyond, joint_shifts
from core.rig.compensation import CommonShift, SeenTarget, Shifts, noise_share, raw_displacement
from core.rig.propagation import mean_of, turn_and_scale_of
from core.rig.stability import stability_terms
from core.site import StabilityBudget, TargetRole
from tests.core.places import seen_there
from tests.core.scenes import small_site

DAY_S = 86_400.0


def joint(shift_mm: list[list[float]], fixed: list[bool], common_mm: float = 0.4) -> JointShifts:
    """Targets side by side: one common error of so much, and 0.003 mm of their own."""
    n = 2 * len(fixed)
    each = np.tile(np.eye(2), (len(fixed), 1))
    return JointShifts(
        tuple(f"t{k}" for k in range(len(fixed))),
        tuple(fixed),
        tuple(slice(2 * k, 2 * k + 2) for k in range(len(fixed))),
        np.array(shift_mm, dtype=float).ravel(),
        0.003**2 * np.eye(n),
        np.zeros((n, n)),
        common_mm**2 * each @ each.T,
    )


def test_without_a_fixed_target_the_value_stays_and_the_budget_is_its_sigma() -> None:
    alone = close(joint([[5.0, 1.0]], [False]), ())["t0"]
    assert alone.mm.tolist() == [5.0, 1.0]
    assert np.sqrt(alone.covariance_mm2[0, 0]) == pytest.approx(0.4, rel=1e-3)
    assert alone.image_mm2 is not None
    assert np.sqrt(alone.image_mm2[0, 0]) == pytest.approx(0.003)


def test_one_fixed_target_takes_the_common_error_off() -> None:
    both = joint([[5.3, 0.8], [0.3, -0.2]], [False, True])
    found = close(both, ["t1"])
    np.testing.assert_allclose(found["t0"].mm, [5.0, 1.0], atol=1e-3)
    sigma = np.sqrt(np.diag(found["t0"].covariance_mm2))
    np.testing.assert_allclose(sigma, 0.003 * np.sqrt(2.0), rtol=1e-2)
    np.testing.assert_allclose(found["t1"].mm, [0.3, -0.2])  # the closure itself


def test_a_fixed_target_that_is_not_believed_changes_nothing() -> None:
    both = joint([[5.3, 0.8], [0.3, -0.2]], [False, True])
    assert close(both, ())["t0"].mm.tolist() == [5.3, 0.8]


def test_the_closure_is_the_mean_of_the_fixed_targets() -> None:
    three = joint([[5.0, 1.0], [0.3, -0.2], [0.304, -0.2]], [False, True, True])
    closure = closure_of(three, ["t1", "t2"])
    assert closure is not None
    np.testing.assert_allclose(closure.mm, [0.302, -0.2], atol=1e-9)
    assert closure_of(three, ()) is None


@pytest.mark.parametrize("moved", [1, 2, 3])
def test_of_three_fixed_targets_the_one_that_moved_is_found(moved: int) -> None:
    shifts = [[5.3, 0.8], [0.3, -0.2], [0.3, -0.2], [0.3, -0.2]]
    shifts[moved] = [0.3, 0.1]  # knocked by 0.3 mm
    four = joint(shifts, [False, True, True, True])
    assert consistent(four, ["t1", "t2", "t3"]) == [f"t{k}" for k in (1, 2, 3) if k != moved]


def test_fixed_targets_that_agree_are_all_believed() -> None:
    three = joint([[5.3, 0.8], [0.3, -0.2], [0.306, -0.204]], [False, True, True])
    assert consistent(three, ["t1", "t2"]) == ["t1", "t2"]


def test_a_closure_is_beyond_only_what_the_budget_allows() -> None:
    def of(closure_mm: float) -> bool:
        closure = closure_of(joint([[0.0, 0.0], [closure_mm, 0.0]], [False, True]), ["t1"])
        assert closure is not None
        return is_beyond(closure)

    assert not of(1.0)  # 2.5 sigma
    assert of(2.5)  # 6 sigma


@pytest.mark.parametrize(("distance_mm", "air_mm"), [(11e3, 0.06), (22e3, 0.23), (40e3, 0.75)])
def test_the_air_bends_the_line_of_sight_with_the_square_of_the_distance(
    distance_mm: float, air_mm: float
) -> None:
    budget = _only(air_gradient_k_per_m=1.0)
    sigma_mm = _sigma_mm(distance_mm, budget, days=3.0, kelvin=None)
    assert sigma_mm[1] == pytest.approx(air_mm, rel=0.1)
    assert sigma_mm[0] < 0.5 * sigma_mm[1]


def test_cameras_that_turn_against_each_other_count_with_the_distance() -> None:
    """2 urad/K over 10 K at 22 m are 0.44 mm; 1 urad/sqrt(day) after 100 days are 0.22 mm."""
    by_warmth = _sigma_mm(22e3, _only(cameras_urad_per_k=2.0), days=1.0, kelvin=10.0)
    assert by_warmth == pytest.approx([0.44, 0.44])
    creep = _sigma_mm(22e3, _only(cameras_urad_per_sqrt_day=1.0), days=100.0, kelvin=0.0)
    assert creep == pytest.approx([0.22, 0.22])


def test_where_no_camera_tells_its_temperature_it_may_have_changed_after_hours() -> None:
    budget = _only(cameras_urad_per_k=2.0, temperature_range_k=10.0)
    assert _sigma_mm(22e3, budget, days=30.0, kelvin=None) == pytest.approx([0.44, 0.44])
    at_once = _sigma_mm(22e3, budget, days=0.5 / 24, kelvin=None)
    assert max(at_once) < 0.005  # half an hour, as between a calibration and its check


def _only(**budget: float) -> StabilityBudget:
    nothing = dict.fromkeys(StabilityBudget.__slots__, 0.0)
    return StabilityBudget(**{**nothing, **budget})


def _sigma_mm(
    distance_mm: float, budget: StabilityBudget, days: float, kelvin: float | None
) -> list[float]:
    """1 sigma of x and y that a time and a change of temperature add."""
    site = replace(small_site(distance_mm), stability=budget)
    warm = (None, None) if kelvin is None else (20.0, 20.0 + kelvin)
    terms = stability_terms(site, 6.0, Moment(0.0, warm[0]), Moment(days * DAY_S, warm[1]))
    state = sum(np.diag(term.covariance) for term in terms)
    px2 = state[:2] + state[4:]
    return np.sqrt(px2 / 6.0**2).tolist()


CENTRE_PX = np.array([480.0, 300.0])
DISCS_PX = 60.0 * np.array([[-1.0, 0.7], [1.0, 0.7], [0.0, 0.0], [-1.0, -0.7], [1.0, -0.7]])
PX_PER_MM = 3.0


def _target(name: str, role: TargetRole | None, middle_px: list[float]) -> CalibratedTarget:
    B = PX_PER_MM * np.diag([1.0, -1.0])
    reference_px = np.array(middle_px) + DISCS_PX
    return CalibratedTarget(name, role, reference_px, np.zeros(5), B, 22000.0, 0.0)


def _shifts(grown: float, turned_rad: float, displaced_mm: np.ndarray) -> Shifts:
    """What a main target and a fixed one show when the lens has grown and the camera rolled."""
    equal = np.full(5, 0.2)
    turn = np.array([[1.0, -turned_rad], [turned_rad, 1.0]])
    values, places_px = [], []
    targets = (_target("main", None, [300.0, 310.0]), _target("pier", TargetRole.FIXED, [620, 280]))
    for target in targets:
        true_px = target.reference_px + (target.B @ displaced_mm if target.role is None else 0.0)
        now_px = CENTRE_PX + (1.0 + grown) * (true_px - CENTRE_PX) @ turn.T
        sums = mean_of(equal)
        if target.is_fixed:
            sums = np.concatenate([sums, turn_and_scale_of(equal, target.reference_px)])
        values.append(np.einsum("mka,ka->m", sums, now_px - target.reference_px))
        places_px.append(now_px.mean(axis=0))
    common = CommonShift(np.arange(5), equal, 0.0, 0.0)
    return Shifts(
        targets,
        (common, common),
        (slice(0, 2), slice(2, 6)),
        np.concatenate(values),
        np.diag([*[1e-4] * 4, 1e-6, 1e-6]) ** 2,
        np.zeros((6, 6)),
        tuple(target.B for target in targets),
        tuple(places_px),
    )


def test_a_lens_that_has_grown_scales_the_displacement_too() -> None:
    """By a thousandth, as 14 K do: 5 mm would be wrong by 0.005 mm; the fixed target shows it."""
    site = replace(
        small_site(22000.0, stability=_only(main_scale_per_k=7e-5, cameras_urad_per_k=1.5)),
        extra_targets=(),
    )
    terms = stability_terms(site, PX_PER_MM, Moment(0.0, 0.0), Moment(DAY_S, 14.0))
    displaced_mm = np.array([0.5, 5.0])
    shifts = _shifts(1e-3, 2e-5, displaced_mm)
    found = close(joint_shifts(shifts, site, CENTRE_PX, terms), ["pier"])["main"]
    np.testing.assert_allclose(found.mm, displaced_mm, atol=4e-4)
    assert np.sqrt(np.diag(found.covariance_mm2)).max() < 1e-3


def test_discs_that_a_lens_or_a_roll_moves_against_one_another_are_no_noise() -> None:
    """A turn of the target that the rig's roll does not explain is seen all the same."""
    target = _target("pier", TargetRole.FIXED, [620.0, 280.0])
    calibrated = seen_there(target.reference_px, target.B, target)
    rng = np.random.default_rng(1)

    def seen(points_px: np.ndarray) -> tuple[float, float]:
        noise_px2 = np.tile(0.002**2 * np.eye(2), (5, 1, 1))
        discs = Discs(np.ones(5, bool), points_px, noise_px2, np.ones(5), 100.0, 1.0)
        raw, common = raw_displacement(calibrated, SeenTarget(target, discs))
        return common.residual_px, PX_PER_MM * float(np.sqrt(raw.covariance_mm2[0, 0]))

    away = target.reference_px - target.middle_px
    noisy = target.reference_px + rng.normal(0.0, 0.002, (5, 2))
    still_px, usual_px = seen(noisy)
    grown_px, sigma_px = seen(noisy + 1e-3 * away)
    assert grown_px == pytest.approx(still_px, abs=1e-5)
    assert sigma_px == pytest.approx(usual_px, rel=1e-3)
    turned_px, sigma_px = seen(noisy + 2e-3 * away[:, ::-1] * [-1.0, 1.0])
    assert turned_px > 0.05
    assert sigma_px == pytest.approx(usual_px, rel=1e-2)
    assert seen(noisy + 5e-3 * away * [1.0, -1.0])[0] > 0.05  # squeezed, as no plate is


def test_noise_is_as_predicted_in_the_mean_and_follows_what_is_seen() -> None:
    """Only ever adding what is seen beyond the prediction would make it 1.4 times as large."""
    rng = np.random.default_rng(2)
    spread = rng.chisquare(6, 4000) / 6 * (1.0 + 0.8)
    shares = [noise_share(1.0, 0.8, one, 6) for one in spread.tolist()]
    assert np.mean(shares) == pytest.approx(1.0, abs=0.15)
    assert noise_share(1.0, 0.8, 1.8, 6) == pytest.approx(1.0)
    # Where discs scatter ten times as much as they should, most of it is believed.
    assert 60.0 < noise_share(1.0, 0.8, 100.0, 6) < 100.0
    assert 0.1 < noise_share(1.0, 0.0, 0.0, 6) < 0.5
