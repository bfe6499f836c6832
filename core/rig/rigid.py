"""The rigid rig: how the sub-camera's motion moves the main camera's image.

u = pi(K_M, R_CM_CS (R_j p + T_j) + t_CM_CS), with (R_j, T_j) = T_CSj_CS1 of Eq. 12 and p a
point of the main target in CS1. The main camera's focal length and the target's depth are
unknowns with survey priors; their ratio, the scale in px/mm, is measured on the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray, IntArray
from core.geometry.pose import Pose, skew_matrix

RIG_PARAMETERS = 8
"""Rotation of CM against CS about the CM axes (3, rad), offset (3, mm), ln depth, ln scale."""


@dataclass(frozen=True, slots=True)
class MainView:
    """The main target's discs in one calibration view, with their places in the reference."""

    points_px: FloatArray
    """(n, 2) in this view."""
    reference_px: FloatArray
    """(n, 2) in the reference view."""
    sigma_px: FloatArray
    """(n,) of a coordinate in this view, 1 sigma."""
    which: IntArray
    """(n,) the discs' indices on the target."""


@dataclass(frozen=True, slots=True)
class Rig:
    """`T_CM_CS`, the target's depth, and the main camera's scale.

    A turn of the rig by 1 mrad shifts the image of a target 11 m away by 11 mm times the scale:

    >>> back_to_back = Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, -80.0]))
    >>> rig = Rig(back_to_back, 11000.0, 12.5, np.array([959.5, 599.5]))
    >>> motion = Pose.from_vectors(np.array([0.0, 1e-3, 0.0]), np.zeros(3))  # T_CSj_CS1
    >>> target_px = np.array([[959.5, 599.5]])
    >>> (rig.move(target_px, motion) - target_px).round(1).tolist()
    [[138.5, 0.0]]
    """

    T_CM_CS: Pose
    depth_mm: float
    """Of the main target along the optical axis in the reference view."""
    scale_px_per_mm: float
    """Of the main camera at that depth: focal length in px / depth."""
    centre_px: FloatArray
    """(2,) principal point of the main camera."""

    @property
    def focal_px(self) -> float:
        """Focal length of the main camera, px."""
        return self.scale_px_per_mm * self.depth_mm

    def perturbed(self, step: FloatArray) -> Rig:
        """Take a small step (8,)."""
        return Rig(
            self.T_CM_CS.perturbed(step[:6]),
            self.depth_mm * float(np.exp(step[6])),
            self.scale_px_per_mm * float(np.exp(step[7])),
            self.centre_px,
        )

    def deviation_from(self, start: Rig) -> FloatArray:
        """(8,) step that leads from this rig back to `start`."""
        turn = start.T_CM_CS.R @ self.T_CM_CS.R.T
        return np.concatenate(
            [
                Rotation.from_matrix(turn).as_rotvec(),
                start.T_CM_CS.t_mm - self.T_CM_CS.t_mm,
                [np.log(start.depth_mm / self.depth_mm)],
                [np.log(start.scale_px_per_mm / self.scale_px_per_mm)],
            ]
        )

    def target_points_CM1(self, reference_px: FloatArray) -> FloatArray:
        """Points on the target (n, 3) in CM1 from their reference image (n, 2)."""
        rays = (reference_px - self.centre_px) / self.focal_px
        return self.depth_mm * np.concatenate([rays, np.ones((len(rays), 1))], axis=1)

    def move(self, reference_px: FloatArray, motion: Pose) -> FloatArray:
        """Image (n, 2) of target points at rest after the rig has moved by T_CSj_CS1."""
        T_CM = self.T_CM_CS
        points_CS1 = T_CM.inverse().apply(self.target_points_CM1(reference_px))
        moved = T_CM.apply(motion.apply(points_CS1))
        return self.centre_px + self.focal_px * moved[:, :2] / moved[:, 2:]

    def move_jacobians(
        self, reference_px: FloatArray, motion: Pose
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`move` with d/d(motion) (n, 2, 6), as Pose.perturbed, and d/d(rig) (n, 2, 8)."""
        T_CM = self.T_CM_CS
        points_CM1 = self.target_points_CM1(reference_px)
        points_CS1 = T_CM.inverse().apply(points_CM1)
        rotated = points_CS1 @ motion.R.T
        moved = T_CM.apply(rotated + motion.t_mm)
        by_point = np.zeros((len(moved), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = self.focal_px / moved[:, 2]
        by_point[:, :, 2] = -self.focal_px * moved[:, :2] / moved[:, 2:] ** 2
        by_motion = np.empty((len(moved), 2, 6))
        by_motion[:, :, :3] = -by_point @ T_CM.R @ skew_matrix(rotated)
        by_motion[:, :, 3:] = by_point @ T_CM.R
        by_rig = self._by_rig(points_CM1, moved, by_point, motion)
        return self.centre_px + self.focal_px * moved[:, :2] / moved[:, 2:], by_motion, by_rig

    def _by_rig(
        self, points_CM1: FloatArray, moved: FloatArray, by_point: FloatArray, motion: Pose
    ) -> FloatArray:
        """d(u)/d(rig parameters).

        With Q = R_CM R_j R_CM^T the moved point is X' = Q (X - t) + R_CM T_j + t, where
        X = ((u - c) / scale, depth).
        """
        T_CM = self.T_CM_CS
        turn = T_CM.R @ motion.R @ T_CM.R.T
        lever = points_CM1 - T_CM.t_mm
        by_rig = np.empty((len(moved), 2, RIG_PARAMETERS))
        # R_CM <- exp(e) R_CM: X' changes by e x (X' - t) - Q (e x (X - t)).
        by_rotation = -skew_matrix(moved - T_CM.t_mm) + turn @ skew_matrix(lever)
        by_rig[:, :, :3] = by_point @ by_rotation
        by_rig[:, :, 3:6] = by_point @ (np.eye(3) - turn)
        lateral = points_CM1 * np.array([1.0, 1.0, 0.0])
        along = points_CM1 * np.array([0.0, 0.0, 1.0])
        image = self.focal_px * moved[:, :2] / moved[:, 2:]
        # X = ((u - c) / scale, depth): depth moves only the axial part, scale the lateral parts.
        by_rig[:, :, 6] = (by_point @ (along @ turn.T)[:, :, None])[:, :, 0] + image
        by_rig[:, :, 7] = -(by_point @ (lateral @ turn.T)[:, :, None])[:, :, 0] + image
        return by_rig


def rig_residuals(
    rig: Rig, main: MainView, pose: Pose, reference: Pose
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals (n, 2) px of one view's discs, and d(model) by rig, by pose and by reference.

    The motion is T_CSj_CS1 = T_CSj_WS inv(T_CS1_WS), Eq. 12.
    """
    motion = pose.compose(reference.inverse())
    model, by_motion, by_rig = rig.move_jacobians(main.reference_px, motion)
    by_pose = by_motion @ motion_by_pose(motion, reference)
    by_reference = by_motion @ motion_by_reference(motion, reference)
    return main.points_px - model, by_rig, by_pose, by_reference


def motion_by_pose(motion: Pose, reference: Pose) -> FloatArray:
    """d(T_CSj_CS1)/d(T_CSj_WS), (6, 6): T_j = t_j - R_j t_1, so a turn also moves T_j."""
    jacobian = np.eye(6)
    jacobian[3:, :3] = skew_matrix(motion.R @ reference.t_mm)
    return jacobian


def motion_by_reference(motion: Pose, reference: Pose) -> FloatArray:
    """d(T_CSj_CS1)/d(T_CS1_WS), (6, 6): R_j <- R_j exp(-e)."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = -motion.R
    jacobian[3:, :3] = -motion.R @ skew_matrix(reference.t_mm)
    jacobian[3:, 3:] = -motion.R
    return jacobian
