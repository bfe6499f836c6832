"""What a calibration predicts for its rows, and what it asks of the motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.arrays import FloatArray
from core.calibration.observability import drift_errors, drift_motions, require_motion
from core.checkerboard.resection import resect
from core.errors import NotObservableError
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.compensation import corrected_displacement
from core.rig.posterior import Posterior
from core.rig.propagation import expected_sensitivities
from tests.core.sampling import SITE, Truth, calibrated, discs_of, draw, head_motion


@pytest.fixture(scope="module")
def known() -> tuple[Truth, CalibratedSite]:
    """A true site and its calibration."""
    rng = np.random.default_rng(4)
    truth = draw(rng)
    return truth, calibrated(truth, rng)[0]


def _row_covariance(
    truth: Truth, calibrated: CalibratedSite, motion: Pose, seed: int = 0
) -> FloatArray:
    rng = np.random.default_rng(seed)
    view = truth.see_board(motion.compose(truth.reference), rng)
    board = resect(calibrated.lens, calibrated.corners_mm, view)
    discs = discs_of(truth.see_discs(motion, np.zeros(2), rng))
    return corrected_displacement(calibrated, discs, board, view)[0].covariance_mm2


def test_the_expected_error_is_what_rows_then_carry(known: tuple[Truth, CalibratedSite]) -> None:
    """For each direction of the drift the report's figure is the sigma of a row after it."""
    truth, calibrated = known
    for error, motion in zip(
        drift_errors(calibrated, SITE), drift_motions(SITE.quality), strict=True
    ):
        row = np.sqrt(np.linalg.eigvalsh(_row_covariance(truth, calibrated, motion)).max())
        assert error.sigma_mm == pytest.approx(row, rel=0.1), error.motion
        assert 0.0 < error.calibration_mm < error.sigma_mm


def test_a_compressed_posterior_gives_the_same_sigma(known: tuple[Truth, CalibratedSite]) -> None:
    """Stored are the few directions that rows can feel; motions never asked about feel no other."""
    truth, calibrated = known
    effects = [
        expected_sensitivities(calibrated, SITE.sub, motion)[0].propagate(calibrated.posterior)
        for motion in drift_motions(SITE.quality)
    ]
    small = calibrated.posterior.compressed(np.concatenate(effects))
    stored = Posterior.from_dict(small.to_dict())
    assert stored.lens.shape[1] < calibrated.posterior.lens.shape[1] / 3
    rng = np.random.default_rng(5)
    for _ in range(4):
        motion = Pose.from_vectors(rng.uniform(-1e-3, 1e-3, 3), rng.uniform(-1.5, 1.5, 3))
        whole = _row_covariance(truth, calibrated, motion)
        again = _row_covariance(truth, replace(calibrated, posterior=stored), motion)
        assert np.diag(again) == pytest.approx(np.diag(whole), rel=0.01)


def test_what_is_known_for_sure_no_longer_counts(known: tuple[Truth, CalibratedSite]) -> None:
    """Knowing lens, rig or board makes no direction of the drift worse, and some better."""
    _, calibrated = known
    whole = calibrated.posterior
    before = np.array([e.calibration_mm for e in drift_errors(calibrated, SITE)])
    for left in (
        whole.conditioned_on(whole.lens),
        whole.conditioned_on(whole.model),
        whole.conditioned_on_board(),
    ):
        after = [e.calibration_mm for e in drift_errors(replace(calibrated, posterior=left), SITE)]
        assert np.all(after <= 1.001 * before)
        assert np.min(after / before) < 0.99


def test_one_distorted_view_does_not_hide_that_the_rig_turned() -> None:
    """A view that seems to have turned by half a radian says nothing of the other twenty."""
    rng = np.random.default_rng(6)
    turns = [head_motion(*rng.uniform(-2e-3, 2e-3, 2)) for _ in range(20)]
    distorted = Pose.from_vectors(np.array([0.5, 0.1, 0.0]), np.zeros(3))
    require_motion([*turns, distorted])
    pans = [head_motion(pan, 0.0) for pan in rng.uniform(-2e-3, 2e-3, 20)]
    with pytest.raises(NotObservableError, match="tilt"):
        require_motion([*pans, distorted])
