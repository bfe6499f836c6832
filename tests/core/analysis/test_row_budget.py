"""The budget of a row: its causes come to the row's own sigma, and a Monte Carlo agrees."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from core.analysis.budget import Budget, DatumPart, RowState, coverage_factor, two_digits
from core.analysis.monte_carlo import monte_carlo
from core.analysis.row_budget import row_budget
from core.checkerboard.resection import BoardPose
from core.discs.disc_finder import Discs
from core.geometry.pose import Pose
from core.measurement import measure_pair
from core.moment import Moment
from core.results import Measurement
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.closure import close, gains_of, joint_shifts
from core.rig.compensation import SeenTarget, raw_displacement, remaining_shifts, rig_motion
from core.rig.propagation import expected_view, predict_shift_of
from core.rig.reference_places import errors_at_reference
from core.rig.stability import Term, main_scale, stability_terms
from core.site import ExtraTarget, Site, TargetRole
from tests.core.scenes import MINUTE, reference_utc
from tests.core.sessions import Session
from tests.exhaustive import one_of

LINK_GAIN = np.array([[0.95, 0.0, 3.0, -40.0], [0.0, 0.95, 40.0, 3.0]])
MONTH_S = 30 * 86400.0


def state_of(measurement: Measurement) -> RowState:
    assert measurement.motion is not None
    assert measurement.raw is not None
    assert measurement.corrected is not None
    motion = measurement.motion
    return RowState(
        Pose.from_vectors(motion.rotation_rad, motion.translation_mm),
        motion.covariance,
        {"main": measurement.raw.covariance_mm2},
        {"main": measurement.raw.mm},
        corners=measurement.diagnostics.corners_used,
        image_mm2=measurement.corrected.by_image_mm2,
    )


def measured(session: Session, *, stable: bool) -> tuple[Measurement, tuple[Term, ...]]:
    """A row an hour on in the drift, as of a month and 5 K later; terms of the stability budget."""
    reference = Moment(reference_utc(session.world.settings).timestamp(), 10.0)
    calibration = replace(session.calibration, reference=reference)
    now = None if stable else Moment(reference.utc_s + MONTH_S, 15.0)
    pair = session.pair(session.world.settings.start_utc + 60 * MINUTE)
    found = measure_pair(*pair, session.site, calibration, moment=now)
    scale, lens = main_scale(calibration.calibrated.B), calibration.calibrated.lens
    terms = () if now is None else stability_terms(session.site, scale, reference, now, lens)
    return found, terms


@pytest.mark.parametrize("stable", [True, False], ids=["pixels alone", "after a month"])
def test_the_budget_comes_to_the_sigma_of_the_row(usual: Session, stable: bool) -> None:
    found, terms = measured(usual, stable=stable)
    budget = row_budget(usual.site, usual.calibration.calibrated, state_of(found), terms)
    assert found.corrected is not None
    expected = found.corrected.covariance_mm2
    assert np.sqrt(np.diag(budget.covariance_mm2)) == pytest.approx(
        np.sqrt(np.diag(expected)), rel=0.01
    )
    names = [one.name for one in budget.inputs]
    assert len(set(names)) == len(names)
    assert {one.evaluation for one in budget.inputs} == {"A", "B", "A, B"}


def test_correlated_inputs_add_before_they_are_squared(usual: Session) -> None:
    """u_c^2 is the sum of squares and of twice every product with its correlation coefficient."""
    found, terms = measured(usual, stable=False)
    budget = row_budget(usual.site, usual.calibration.calibrated, state_of(found), terms)
    for axis in (0, 1):
        u = np.array([one.contribution_mm(axis) for one in budget.correlated])
        r = budget.correlations(axis)
        assert np.diag(r) == pytest.approx(1.0)
        assert u @ r @ u == pytest.approx(budget.calibration_mm2[axis, axis])
        alone = sum(
            one.contribution_mm(axis) ** 2 for one in budget.inputs if one.factor_mm is None
        )
        assert alone + u @ r @ u == pytest.approx(budget.covariance_mm2[axis, axis])


def test_estimated_causes_widen_the_coverage_factor(usual: Session) -> None:
    """Pixels alone: k = 2. After a month the stability budget counts, known to 25 % only."""
    calibrated = usual.calibration.calibrated
    for stable, factors in ((True, (1.999, 2.02)), (False, (2.02, 2.45))):
        found, terms = measured(usual, stable=stable)
        expanded = row_budget(usual.site, calibrated, state_of(found), terms).expanded(1)
        assert factors[0] < expanded.coverage_factor < factors[1]
        assert expanded.expanded_mm == pytest.approx(
            expanded.coverage_factor * expanded.combined_mm
        )
        assert expanded.coverage_factor == pytest.approx(
            coverage_factor(expanded.degrees_of_freedom)
        )


def with_fixed_plate(session: Session, stable_mm: float) -> tuple[Site, CalibratedSite]:
    """The same site with a plate on the abutment, 45 mm beside the main target."""
    calibrated = session.calibration.calibrated
    place_px = calibrated.main_target.middle_px + np.array([250.0, 20.0])
    reference_px = place_px + 30.0 * np.array([[-1.0, 1.0], [1.0, 1.0], [0.3, -1.0], [-1.0, -1.0]])
    plate = CalibratedTarget(
        *("abutment", TargetRole.FIXED, reference_px, np.full(4, 1e-6), calibrated.B),
        *(11500.0, 20.0),
    )
    extra = ExtraTarget("abutment", TargetRole.FIXED, session.site.main_target, stable_mm=stable_mm)
    return replace(session.site, extra_targets=(extra,)), replace(calibrated, further=(plate,))


def seen(calibrated: CalibratedSite, target: CalibratedTarget, motion: Pose) -> SeenTarget:
    """A target at rest, each disc located to 0.01 px."""
    which = np.arange(len(target.reference_px))
    points = target.reference_px + predict_shift_of(calibrated, target, which, motion).shift_px
    n = len(points)
    noise = np.tile(1e-4 * np.eye(2), (n, 1, 1))
    return SeenTarget(target, Discs(np.ones(n, bool), points, noise, np.ones(n), 100.0, 1.0))


def conditioned(
    session: Session, *, stable_mm: float = 0.02, linked: bool = False
) -> tuple[Budget, np.ndarray, np.ndarray]:
    """Budget with a fixed plate; sigma that the program gives with it, and without.

    linked: in the zero of a record of which it is the second calibration.
    """
    site, calibrated = with_fixed_plate(session, stable_mm)
    motion = Pose.from_vectors(np.array([2e-4, -4e-4, 1e-4]), np.array([0.3, -0.2, 0.1]))
    pose = motion.compose(calibrated.reference_pose)
    view = expected_view(calibrated, site.sub, pose)
    covariance = np.diag([4e-6**2] * 3 + [2e-4**2] * 3)
    board = BoardPose(pose, covariance, np.zeros((len(view.index), 2)), np.ones(len(view.index)), 1)
    targets = [
        seen(calibrated, one, motion) for one in (calibrated.main_target, *calibrated.further)
    ]
    shifts = remaining_shifts(calibrated, targets, board, view)
    terms = stability_terms(
        site, main_scale(calibrated.B), Moment(0.0, 10.0), Moment(MONTH_S, 15.0)
    )
    joint = joint_shifts(shifts, site, site.main.centre_px, terms)
    both, alone = (close(joint, names)["main"].covariance_mm2 for names in (["abutment"], []))
    raw = {one.target.name: raw_displacement(calibrated, one)[0] for one in targets}
    covariances = {name: one.covariance_mm2 for name, one in raw.items()}
    places = {name: one.mm for name, one in raw.items()}
    own = rig_motion(calibrated, board)
    row = RowState(motion, own.covariance, covariances, places, ("abutment",), len(view.index))
    if not linked:
        return row_budget(site, calibrated, row, terms), both, alone
    known = errors_at_reference(calibrated, site.sub)
    by_link = known.by_values("main", {"abutment": LINK_GAIN})
    by_row = known.by_values("main", gains_of(joint, ["abutment"], "main"))
    assert by_link is not None
    assert by_row is not None
    shared = known.covariance @ by_link.T
    part = DatumPart(by_link @ shared + 1e-6 * np.eye(2), known, shared)
    common = by_row @ shared
    both = both + part.covariance_mm2 - common - common.T
    return row_budget(site, calibrated, row, terms, part), both, alone


def test_a_fixed_plate_takes_the_common_causes_off_in_the_budget_too(usual: Session) -> None:
    budget, both, alone = conditioned(usual)
    assert np.sqrt(np.diag(budget.covariance_mm2)) == pytest.approx(
        np.sqrt(np.diag(both)), rel=0.01
    )
    assert np.sqrt(both[1, 1]) < 0.5 * np.sqrt(alone[1, 1])
    own = next(one for one in budget.inputs if one.name.startswith("fixed targets'"))
    assert own.contribution_mm(1) == pytest.approx(0.02, rel=0.3)


def test_what_a_row_shares_with_its_datum_is_in_the_budget_with_its_sign(usual: Session) -> None:
    budget, both, _ = conditioned(usual, stable_mm=0.0, linked=True)
    sigma_mm = np.sqrt(np.diag(budget.covariance_mm2))
    assert sigma_mm == pytest.approx(np.sqrt(np.diag(both)), rel=0.005)
    squares = sum(one.covariance_mm2 for one in budget.inputs if "datum" in one.name)
    apart = conditioned(usual, stable_mm=0.0)[0].covariance_mm2 + squares
    assert (sigma_mm < 0.99 * np.sqrt(np.diag(apart))).all()


@pytest.mark.parametrize(
    "fixed",
    [
        pytest.param("linked", id="with a fixed plate in a record's zero"),
        pytest.param(True, id="with a fixed plate"),
        pytest.param(False, id="alone"),
    ][:: one_of(3)],
)
def test_a_monte_carlo_of_the_model_agrees_with_the_budget(
    usual: Session, fixed: bool | str
) -> None:
    if fixed:
        linked = fixed == "linked"
        budget = conditioned(usual, stable_mm=0.0 if linked else 0.02, linked=linked)[0]
    else:
        found, terms = measured(usual, stable=False)
        budget = row_budget(usual.site, usual.calibration.calibrated, state_of(found), terms)
    drawn = monte_carlo(budget, 3000, np.random.default_rng(5))
    assert drawn is not None
    assert drawn.agrees, drawn.ratio
    assert drawn.interval_ratio == pytest.approx(1.0, abs=0.1)


def test_a_budget_that_forgets_a_cause_is_found_by_the_monte_carlo(usual: Session) -> None:
    """The check can fail: without the corners' noise the budget is too small."""
    found, terms = measured(usual, stable=False)
    budget = row_budget(usual.site, usual.calibration.calibrated, state_of(found), terms)
    short = replace(
        budget,
        inputs=tuple(one for one in budget.inputs if "pose of the board, from" not in one.name),
    )
    drawn = monte_carlo(short, 3000, np.random.default_rng(5))
    assert drawn is not None
    assert not drawn.agrees
    assert drawn.trials < 3000  # it ends once that is decided


@pytest.mark.parametrize(
    ("value", "expanded", "texts"),
    [
        (-3.21417, 0.12345, ("-3.21", "0.12")),
        (1.0, 0.0996, ("1.00", "0.10")),
        (-0.0001, 0.104, ("0.00", "0.10")),
        (5.5555, 0.0104, ("5.556", "0.010")),
        (5.5555, 0.01104, ("5.556", "0.011")),
        (123.4, 23.4, ("123", "23")),
        (123.4, 234.0, ("123", "230")),
    ],
)
def test_a_statement_has_two_digits_of_uncertainty(
    value: float, expanded: float, texts: tuple[str, str]
) -> None:
    assert two_digits(value, expanded) == texts
    assert math.isclose(float(texts[1]), expanded, rel_tol=0.051)
