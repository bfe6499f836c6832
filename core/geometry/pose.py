"""Rigid motions: `Pose` is `T_a_b`, taking coordinates in frame b to frame a."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Pose:
    """`T_a_b`: X_a = R X_b + t.

    >>> T_a_b = Pose.from_vectors(np.array([0.0, 0.0, np.pi / 2]), np.array([10.0, 0.0, 0.0]))
    >>> T_a_b.apply(np.array([[1.0, 0.0, 0.0]])).round(9).tolist()
    [[10.0, 1.0, 0.0]]
    >>> T_a_b.inverse().compose(T_a_b).vector.round(9).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """

    R: FloatArray
    """(3, 3) rotation matrix."""
    t_mm: FloatArray
    """(3,) translation, mm."""

    @classmethod
    def identity(cls) -> Pose:
        """Give the motion that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_vectors(cls, rotation_rad: FloatArray, t_mm: FloatArray) -> Pose:
        """Build from a rotation vector (3,) rad and a translation (3,) mm."""
        return cls(Rotation.from_rotvec(rotation_rad).as_matrix(), np.asarray(t_mm, dtype=float))

    @property
    def rotation_rad(self) -> FloatArray:
        """(3,) rotation vector, rad."""
        return np.asarray(Rotation.from_matrix(self.R).as_rotvec())

    @property
    def vector(self) -> FloatArray:
        """(6,) rotation vector and translation."""
        return np.concatenate([self.rotation_rad, self.t_mm])

    def apply(self, points_mm: FloatArray) -> FloatArray:
        """Take points (n, 3) from frame b to frame a."""
        return points_mm @ self.R.T + self.t_mm

    def compose(self, other: Pose) -> Pose:
        """`T_a_c = T_a_b T_b_c`."""
        return Pose(self.R @ other.R, self.R @ other.t_mm + self.t_mm)

    def inverse(self) -> Pose:
        """`T_b_a`."""
        return Pose(self.R.T, -self.R.T @ self.t_mm)

    def perturbed(self, delta: FloatArray) -> Pose:
        """Apply a small step (6,): rotation about the axes of frame a, then translation.

        R <- exp(delta_r) R, t <- t + delta_t; `apply` then changes by
        delta_r x (R X_b) + delta_t to first order.
        """
        step = Rotation.from_rotvec(delta[:3]).as_matrix()
        return Pose(step @ self.R, self.t_mm + delta[3:])


def skew_matrix(v: FloatArray) -> FloatArray:
    """`[v]_x` of vectors (..., 3), so that [v]_x w = v x w; shape (..., 3, 3).

    >>> (skew_matrix(np.array([0.0, 0.0, 2.0])) @ np.array([1.0, 0.0, 0.0])).tolist()
    [0.0, 2.0, 0.0]
    """
    skew = np.zeros((*v.shape, 3))
    skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    skew[..., 1, 2], skew[..., 2, 0], skew[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return skew
