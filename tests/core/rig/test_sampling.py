"""The joint adjustment by sampling: true sites drawn from the priors, errors against covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.checkerboard.board_shape import board_terms, shape_terms
from core.checkerboard.resection import BoardView, resect
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.rig.compensation import corrected_displacement
from core.rig.propagation import sensitivity_through_pose
from core.rig.rigid import Rig
from tests.core.derivatives import by_differences
from tests.core.sampling import BOARD, DISC_PX, SITE, calibrated, discs_of, draw

TRIALS = 10
FREE_LENS = [0, 1, 3, 4, 5, 6, 7, 8, 9]
"""All but the skew, which is held."""


@pytest.fixture(scope="module")
def trials() -> dict[str, FloatArray]:
    """Errors over their predicted sigma of lens, rig, and four displacements of each site."""
    lens, rig, displacement, error = [], [], [], []
    for seed in range(TRIALS):
        rng = np.random.default_rng(seed)
        truth = draw(rng)
        calibrated_site, _ = calibrated(truth, rng)
        assert isinstance(calibrated_site.model, Rig)
        posterior = calibrated_site.posterior
        lens.append(
            (calibrated_site.lens.parameters - truth.lens.parameters)[FREE_LENS]
            / posterior.lens_sigma[FREE_LENS]
        )
        rig.append(calibrated_site.model.deviation_from(truth.rig) / posterior.model_sigma)
        for _ in range(4):
            motion = Pose.from_vectors(rng.uniform(-1e-3, 1e-3, 3), rng.uniform(-1.5, 1.5, 3))
            moved_mm = rng.uniform(-5.0, 5.0, 2)
            view = truth.see_board(motion.compose(truth.reference), rng)
            board = resect(calibrated_site.lens, calibrated_site.corners_mm, view)
            discs = discs_of(truth.see_discs(motion, moved_mm, rng))
            found, _ = corrected_displacement(calibrated_site, discs, board, view)
            error.append(found.mm - moved_mm)
            displacement.append(
                np.linalg.solve(np.linalg.cholesky(found.covariance_mm2), error[-1])
            )
    return {
        "lens": np.array(lens),
        "rig": np.array(rig),
        "displacement": np.array(displacement),
        "error_mm": np.array(error),
    }


@pytest.mark.parametrize("what", ["lens", "rig"])
def test_covariance_is_that_of_the_errors(trials, what) -> None:
    """Over many true sites the errors of lens and rig have their predicted size, each of them."""
    z = trials[what]
    assert 0.8 < np.sqrt((z**2).mean()) < 1.2
    assert np.sqrt((z**2).mean(axis=0)).max() < 1.7
    assert np.abs(z.mean(axis=0)).max() < 1.0


def test_displacement_has_its_predicted_error(trials) -> None:
    """From the corners' noise through the calibration to mm; rather too careful than too bold."""
    z = trials["displacement"]
    assert 0.5 < np.sqrt((z**2).mean()) < 1.2
    assert np.mean(np.abs(z) < 1.0) > 0.6
    assert np.sqrt((trials["error_mm"] ** 2).mean()) < 0.6


def test_the_views_teach_what_the_drawing_does_not() -> None:
    """The rig's rotation about its axis: known to 1 degree from the drawing, better after."""
    rng = np.random.default_rng(0)
    truth = draw(rng)
    calibrated_site, adjusted = calibrated(truth, rng)
    sigma = calibrated_site.posterior.model_sigma
    prior_rad = np.radians(SITE.rig.rotation_sigma_deg)
    assert sigma[2] < 0.5 * prior_rad
    assert np.all(sigma <= 1.001 * np.array([prior_rad] * 3 + [3.0] * 3 + [20 / 11000, 2e-3]))
    assert adjusted.scale == pytest.approx(1.0, abs=0.15)
    assert adjusted.main_rms_px < 2.0 * DISC_PX


def test_pose_follows_lens_and_board_as_predicted() -> None:
    """`sensitivity_through_pose` against poses fitted again with each parameter changed."""
    rng = np.random.default_rng(3)
    truth = draw(rng)
    px = truth.lens.project(truth.reference.apply(truth.corners_mm))
    n = len(px)
    view = BoardView(np.arange(n), px, np.tile(0.01**2 * np.eye(2), (n, 1, 1)))
    by_lens, by_corners = sensitivity_through_pose(
        truth.lens, truth.reference, truth.corners_mm, view, view.whitening(), np.eye(6)
    )

    def fitted(lens: Lens, corners_mm: FloatArray) -> FloatArray:
        pose = resect(lens, corners_mm, view, truth.reference).pose
        turn = Rotation.from_matrix(pose.R @ truth.reference.R.T).as_rotvec()
        return np.concatenate([turn, pose.t_mm - truth.reference.t_mm])

    numeric = by_differences(
        lambda d: fitted(truth.lens.moved(d), truth.corners_mm),
        np.array([1e-2] * 5 + [1e-5] * 5),
    )
    assert np.all(np.abs(by_lens - numeric) < 1e-3 * np.abs(numeric).max(axis=0) + 1e-12)
    corner = 17
    shift = np.zeros((n, 3, 3))
    shift[corner] = np.eye(3)
    numeric = by_differences(
        lambda d: fitted(truth.lens, truth.corners_mm + shift @ d), np.full(3, 1e-5)
    )
    assert np.all(np.abs(by_corners[:, corner] - numeric) < 1e-3 * np.abs(numeric).max() + 1e-12)


def test_shape_terms_are_scale_and_bow() -> None:
    """The first widens the board about its middle, the fourth bows it out of its plane."""
    terms = shape_terms(BOARD)
    assert terms.shape == (len(BOARD.corners_mm), 3, 13)
    middle = BOARD.corners_mm.mean(axis=0)
    wider = BOARD.corners_mm + terms @ np.eye(13)[0]
    assert wider - middle == pytest.approx((BOARD.corners_mm - middle) * [2.0, 1.0, 1.0])
    bowed = terms @ np.eye(13)[3]
    assert np.abs(bowed[:, :2]).max() == 0.0
    assert bowed[:, 2].max() == pytest.approx(1.0)


def test_lines_are_columns_and_rows() -> None:
    """A column's error moves all its corners sideways, a row's all its corners down."""
    terms = board_terms(BOARD)[:, :, 13:]
    assert terms.shape == (len(BOARD.corners_mm), 3, BOARD.columns + BOARD.rows)
    third_column, second_row = terms[:, 0, 2], terms[:, 1, BOARD.columns + 1]
    assert np.array_equal(third_column, BOARD.corners_mm[:, 0] == 3 * BOARD.square_mm)
    assert np.array_equal(second_row, BOARD.corners_mm[:, 1] == 2 * BOARD.square_mm)
    assert terms.sum() == 2 * len(BOARD.corners_mm)
