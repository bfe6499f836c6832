"""The paper's dual calibration: nine parameters fitted to the motions (Eq. 15-19).

The baseline. It predicts well for motions like those it was fitted to and can be wrong by
millimetres for others: pan-tilt motion does not determine it (see `null_directions`).
Source: Lee et al., Mech. Syst. Signal Process. 140 (2020).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from core.arrays import FloatArray
from core.geometry.pose import Pose, skew_matrix

_NULL_RATIO = 2e-4
"""Singular value over the largest, below which a direction is open. Pan and tilt leave one that is
zero but for noise, and four more 100 to 10,000 times below the largest (measured)."""
_DOUBTFUL_RATIO = 5e-3
"""Below this the noise of the motions themselves may be all that a direction rests on."""


@dataclass(frozen=True, slots=True)
class PaperModel:
    """`du_j = B [R_j - I, T_j] [p; 1]`, Eq. 17.

    >>> B = 12.5 * np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> model = PaperModel(B, np.array([0.0, 0.0, -11080.0]), np.eye(9), np.ones(9))
    >>> model.shift(Pose.from_vectors(np.array([0.0, 1e-3, 0.0]), np.zeros(3))).round(1).tolist()
    [138.5, 0.0]
    """

    B: FloatArray
    """(2, 3), px per mm."""
    p_mm: FloatArray
    """(3,) the feature in CS1."""
    covariance: FloatArray
    """(9, 9) of (B by rows, p)."""
    singular_values: FloatArray
    """(9,) of the Jacobian of Eq. 18 with columns scaled to unit length, largest first."""

    def shift(self, motion: Pose) -> FloatArray:
        """False shift (2,) px of the feature, Eq. 17."""
        return self.B @ (motion.R @ self.p_mm - self.p_mm + motion.t_mm)

    def shift_jacobians(self, motion: Pose) -> tuple[FloatArray, FloatArray]:
        """d(shift) by motion (2, 6), as Pose.perturbed, and by the nine parameters (2, 9)."""
        rotated = motion.R @ self.p_mm
        by_motion = np.concatenate([-self.B @ skew_matrix(rotated), self.B], axis=1)
        return by_motion, _by_parameters(self.B, self.p_mm, motion)

    @property
    def null_directions(self) -> int:
        """How many of the nine parameters' directions the motions left open."""
        return int((self.singular_values < _NULL_RATIO * self.singular_values[0]).sum())


def _by_parameters(B: FloatArray, p_mm: FloatArray, motion: Pose) -> FloatArray:
    moved = motion.R @ p_mm - p_mm + motion.t_mm
    jacobian = np.zeros((2, 9))
    jacobian[0, :3] = jacobian[1, 3:6] = moved
    jacobian[:, 6:] = B @ (motion.R - np.eye(3))
    return jacobian


def fit_paper(
    motions: Sequence[Pose], shifts_px: FloatArray, start_B: FloatArray, start_p_mm: FloatArray
) -> PaperModel:
    """Fit Eq. 18 to motions and to the feature's shifts (n, 2) px, from start values.

    Along directions that the motions leave open the start values stay.
    """
    scale = np.concatenate(
        [np.full(6, np.abs(start_B).max()), np.full(3, np.abs(start_p_mm).max())]
    )

    def unpack(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return (x[:6] * scale[:6]).reshape(2, 3), x[6:] * scale[6:]

    def residual(x: FloatArray) -> FloatArray:
        B, p = unpack(x)
        predicted = [B @ (m.R @ p - p + m.t_mm) for m in motions]
        return (np.array(predicted) - shifts_px).ravel()

    def jacobian(x: FloatArray) -> FloatArray:
        B, p = unpack(x)
        return np.asarray(np.concatenate([_by_parameters(B, p, m) for m in motions]) * scale)

    start = np.concatenate([start_B.ravel(), start_p_mm]) / scale
    fit = least_squares(
        residual,
        start,
        jac=jacobian,
        method="trf",
        x_scale=1.0,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
        max_nfev=400,
    )
    B, p = unpack(fit.x)
    variance = 2.0 * fit.cost / max(1, shifts_px.size - 9)
    jac = np.asarray(fit.jac, dtype=float)
    columns = np.linalg.norm(jac, axis=0)
    singular = np.linalg.svd(jac / np.maximum(columns, 1e-12), compute_uv=False)
    covariance = _covariance(jac, singular, max(variance, 1e-9), np.asarray(fit.x) - start)
    return PaperModel(B, p, covariance * np.outer(scale, scale), singular)


def _covariance(
    jacobian: FloatArray, singular: FloatArray, variance: float, away: FloatArray
) -> FloatArray:
    """Covariance (9, 9) of the scaled parameters, away (9,) from their start values.

    A direction that the motions leave open is known to the parameters' own size, or to how far
    the fit ran away along it. Its singular value is then not zero by the noise of the motions.
    """
    _, size, directions = np.linalg.svd(jacobian, full_matrices=False)
    information = size**2 / variance
    information[singular < _DOUBTFUL_RATIO * singular[0]] = 0.0
    reach = np.maximum(1.0, np.abs(directions @ away))
    return np.asarray(directions.T @ np.diag(1.0 / (information + 1.0 / reach**2)) @ directions)
