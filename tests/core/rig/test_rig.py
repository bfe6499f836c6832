"""Poses and the rigid rig: composition, and every derivative against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.checkerboard.resection import pose_jacobian
from core.geometry.lens import Lens
from core.geometry.pose import Pose, skew_matrix
from core.rig.paper import PaperModel
from core.rig.rigid import MainView, Rig, motion_by_pose, motion_by_reference, rig_residuals
from tests.core.derivatives import assert_same_derivative, by_differences

LENS = Lens(np.array([1040.0, 1036.0, 2.5, 955.0, 610.0, -0.11, 0.03, 8e-4, -6e-4, -0.004]))
RNG = np.random.default_rng(8)
BOARD_MM = np.column_stack([RNG.uniform(0, 60, (30, 2)), RNG.normal(0, 0.1, 30)])
REFERENCE = Pose.from_vectors(np.array([0.03, -0.02, 0.01]), np.array([-31.0, -30.0, 51.0]))
# Far larger motions than any rig makes, so that a wrong small term shows.
POSE = Pose.from_vectors(np.array([0.09, -0.12, 0.2]), np.array([-29.0, -34.0, 58.0]))
MOTION = POSE.compose(REFERENCE.inverse())
POSE_STEPS = np.array([1e-6] * 3 + [1e-4] * 3)
RIG = Rig(
    Pose(
        Rotation.from_euler("xyz", [1.1, 178.9, -0.7], degrees=True).as_matrix(),
        np.array([1.0, -2.0, -81.0]),
    ),
    11012.0,
    12.3,
    np.array([959.5, 599.5]),
)
RIG_STEPS = np.array([1e-6] * 3 + [1e-2] * 3 + [1e-5] * 2)
DISCS_PX = RNG.uniform(300.0, 900.0, (5, 2))


def _small(motion: Pose) -> Pose:
    """A motion that keeps the main target in front of the main camera."""
    return Pose.from_vectors(0.05 * motion.rotation_rad, motion.t_mm)


def test_poses_compose_as_matrices() -> None:
    """T_a_c = T_a_b T_b_c, an inverse undoes, and a rotation vector comes back."""
    points = RNG.normal(size=(4, 3))
    assert POSE.compose(REFERENCE).apply(points) == pytest.approx(
        POSE.apply(REFERENCE.apply(points))
    )
    assert POSE.inverse().apply(POSE.apply(points)) == pytest.approx(points)
    again = Pose.from_vectors(POSE.rotation_rad, POSE.t_mm)
    assert np.allclose(again.R, POSE.R, rtol=0.0, atol=1e-12)
    assert POSE.vector == pytest.approx([0.09, -0.12, 0.2, -29.0, -34.0, 58.0])


def test_skew_matrix_is_the_cross_product() -> None:
    v, w = RNG.normal(size=(2, 6, 3))
    assert (skew_matrix(v) @ w[:, :, None])[:, :, 0] == pytest.approx(np.cross(v, w))


def test_pose_jacobian() -> None:
    """Corners by pose, by board point and by lens."""
    _, by_pose, by_point, by_lens = pose_jacobian(LENS, POSE, BOARD_MM)
    assert_same_derivative(
        by_pose,
        by_differences(lambda d: LENS.project(POSE.perturbed(d).apply(BOARD_MM)), POSE_STEPS),
    )
    assert_same_derivative(
        by_point,
        by_differences(lambda d: LENS.project(POSE.apply(BOARD_MM + d)), np.full(3, 1e-4)),
    )
    assert_same_derivative(
        by_lens,
        by_differences(
            lambda d: Lens(LENS.parameters + d).project(POSE.apply(BOARD_MM)),
            np.array([1e-2] * 5 + [1e-5] * 5),
        ),
    )


def _step_between(a: Pose, b: Pose) -> np.ndarray:
    """The step (6,) of Pose.perturbed that leads from a to b."""
    return np.concatenate([Rotation.from_matrix(b.R @ a.R.T).as_rotvec(), b.t_mm - a.t_mm])


def test_motion_by_pose_and_by_reference() -> None:
    """Eq. 12: T_CSj_CS1 = T_CSj_WS inv(T_CS1_WS), by either pose."""
    numeric = by_differences(
        lambda d: _step_between(MOTION, POSE.perturbed(d).compose(REFERENCE.inverse())), POSE_STEPS
    )
    assert_same_derivative(motion_by_pose(MOTION, REFERENCE), numeric)
    numeric = by_differences(
        lambda d: _step_between(MOTION, POSE.compose(REFERENCE.perturbed(d).inverse())), POSE_STEPS
    )
    assert_same_derivative(motion_by_reference(MOTION, REFERENCE), numeric)


def test_rig_at_rest_moves_nothing() -> None:
    assert RIG.move(DISCS_PX, Pose.identity()) == pytest.approx(DISCS_PX, abs=1e-9)


def test_a_milliradian_is_eleven_millimetres() -> None:
    """Tilting the back-to-back rig by 1 mrad shifts the main image by 11 mm of target."""
    still = Pose.from_vectors(np.array([1e-3, 0.0, 0.0]), np.zeros(3))
    shift_mm = (RIG.move(DISCS_PX, still) - DISCS_PX) / RIG.scale_px_per_mm
    # The rig turns about the sub-camera's origin, 80 mm behind the main camera.
    assert np.abs(shift_mm[:, 1]) == pytest.approx(np.full(5, 11.09), abs=0.03)
    assert np.abs(shift_mm[:, 0]).max() < 0.5


def test_rig_derivatives() -> None:
    """The discs' places by the motion and by all eight rig parameters."""
    motion = _small(MOTION)
    moved, by_motion, by_rig = RIG.move_jacobians(DISCS_PX, motion)
    assert moved == pytest.approx(RIG.move(DISCS_PX, motion), abs=1e-9)
    numeric = by_differences(lambda d: RIG.move(DISCS_PX, motion.perturbed(d)), POSE_STEPS)
    assert_same_derivative(by_motion, numeric)
    numeric = by_differences(lambda d: RIG.perturbed(d).move(DISCS_PX, motion), RIG_STEPS)
    assert_same_derivative(by_rig, numeric)


def test_rig_residual_derivatives() -> None:
    """What the adjustment uses: the model by rig, by the view's pose and by the reference."""
    pose = _small(MOTION).compose(REFERENCE)
    main = MainView(
        DISCS_PX + 3.0, DISCS_PX, np.full(len(DISCS_PX), 0.01), np.arange(len(DISCS_PX))
    )
    residual, by_rig, by_pose, by_reference = rig_residuals(RIG, main, pose, REFERENCE)
    assert residual == pytest.approx(main.points_px - RIG.move(DISCS_PX, _small(MOTION)), abs=1e-6)

    def model(rig: Rig, at: Pose, reference: Pose) -> np.ndarray:
        return main.points_px - rig_residuals(rig, main, at, reference)[0]

    numeric = by_differences(lambda d: model(RIG.perturbed(d), pose, REFERENCE), RIG_STEPS)
    assert_same_derivative(by_rig, numeric)
    numeric = by_differences(lambda d: model(RIG, pose.perturbed(d), REFERENCE), POSE_STEPS)
    assert_same_derivative(by_pose, numeric)
    numeric = by_differences(lambda d: model(RIG, pose, REFERENCE.perturbed(d)), POSE_STEPS)
    assert_same_derivative(by_reference, numeric)


def test_deviation_leads_back_to_the_drawing() -> None:
    """The prior's deviation is the step that makes the rig the drawn one again."""
    step = np.array([0.01, -0.02, 0.015, 2.0, -1.0, 3.0, 0.002, -0.001])
    built = RIG.perturbed(step)
    back = built.perturbed(built.deviation_from(RIG))
    assert np.allclose(back.T_CM_CS.R, RIG.T_CM_CS.R, rtol=0.0, atol=1e-12)
    assert back.T_CM_CS.t_mm == pytest.approx(RIG.T_CM_CS.t_mm)
    assert (back.depth_mm, back.scale_px_per_mm) == pytest.approx((11012.0, 12.3))


def test_paper_derivatives() -> None:
    """Eq. 17 by the motion and by the nine parameters."""
    B, p = RNG.normal(size=(2, 3)) * 12.0, np.array([3.0, -5.0, -11000.0])
    model = PaperModel(B, p, np.eye(9), np.ones(9))
    motion = _small(MOTION)
    by_motion, by_parameters = model.shift_jacobians(motion)
    assert_same_derivative(
        by_motion, by_differences(lambda d: model.shift(motion.perturbed(d)), POSE_STEPS)
    )
    numeric = by_differences(
        lambda d: PaperModel(B + d[:6].reshape(2, 3), p + d[6:], np.eye(9), np.ones(9)).shift(
            motion
        ),
        np.array([1e-3] * 6 + [1e-1] * 3),
    )
    assert_same_derivative(by_parameters, numeric)
