"""A lens and the poses of the views, fitted to corners of a board that is taken as known.

Much faster than the joint adjustment (core.adjustment.bundle_adjustment): it finds a start for
that, and compares lens models.
Gauss-Newton with robust weights; the poses are eliminated view by view (Schur complement; Triggs
et al., "Bundle adjustment - a modern synthesis" (2000), section 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from core.arrays import FloatArray, IntArray
from core.checkerboard.resection import BoardView, robust_scale, robust_weights
from core.geometry.lens import INTRINSICS, Lens
from core.geometry.pose import Pose, skew_matrix
from core.lens_model import LensModel

_START_SCALE = 30.0
"""Residuals over their predicted size, at the start: no corner is down-weighted while the fit is
still that bad."""
_SETTLED_SIGMAS, _SETTLED_SCALE = 0.05, 0.01
"""Changes after which the fit stops: of the lens, in its sigmas; of the residuals' scale, relative.
It only starts and compares."""
_WIDE_FOCAL, _WIDE_SKEW = 0.1, 0.005
"""1-sigma priors of focal length and principal point, and of gamma, as shares of the focal length:
wider than makers are wrong by."""
_WIDE_RADIAL, _WIDE_FISHEYE, _WIDE_DECENTRING = 0.3, 0.1, 0.02
"""1-sigma priors of the distortion's coefficients: those of usual lenses lie within."""


@dataclass(frozen=True, slots=True)
class FittedLens:
    """A lens with the pose of each view."""

    lens: Lens
    poses: tuple[Pose, ...]

    @property
    def sound(self) -> bool:
        """Whether this can be a lens at all."""
        parameters = self.lens.parameters
        return bool(np.isfinite(parameters).all() and parameters[:2].min() > 0.0)


def wide_prior(lens: Lens, *, skew: bool = False) -> FloatArray:
    """(size,) 1-sigma of the lens parameters about a start: wide for all but the skew."""
    focal = _WIDE_FOCAL * lens.parameters[0]
    gamma = _WIDE_SKEW * lens.parameters[0] if skew else 0.0
    radial = _WIDE_FISHEYE if lens.model is LensModel.FISHEYE else _WIDE_RADIAL
    sigmas = {"p1": _WIDE_DECENTRING, "p2": _WIDE_DECENTRING}
    distortion = [sigmas.get(name, radial) for name in lens.model.coefficients]
    return np.array([focal, focal, gamma, focal, focal, *distortion])


def as_model(lens: Lens, model: LensModel) -> Lens:
    """The same lens with coefficients of the same kind added, all zero, or left off.

    >>> brown = Lens(np.array([900.0, 900.0, 0.0, 320.0, 240.0, -0.1, 0.01, 0.0, 0.0, 0.0]))
    >>> as_model(brown, LensModel.RADIAL).parameters.tolist()
    [900.0, 900.0, 0.0, 320.0, 240.0, -0.1, 0.01]
    """
    parameters = np.zeros(len(model.parameters))
    both = min(lens.size, len(parameters))
    parameters[:both] = lens.parameters[:both]
    if (lens.model is LensModel.FISHEYE) != (model is LensModel.FISHEYE):
        parameters[INTRINSICS:] = 0.0
    return Lens(parameters, model)


def fit_lens(
    start: Lens,
    corners_mm: FloatArray,
    views: Sequence[BoardView],
    poses: Sequence[Pose],
    sigmas: FloatArray,
    iterations: int = 25,
) -> FittedLens:
    """Fit to views of the board with corners (m, 3), from a start near enough.

    sigmas (size,) are 1-sigma priors of the lens about the start; 0 keeps a parameter.
    Raises numpy.linalg.LinAlgError if the views determine too little.
    """
    data = _Corners.of(corners_mm, views)
    fitted, scale = FittedLens(start, tuple(poses)), _START_SCALE
    free = np.nonzero(sigmas > 0.0)[0]
    precision = 1.0 / sigmas[free] ** 2
    for _ in range(iterations):
        jacobian, white = data.linearised(fitted, free)
        norm = np.hypot(white[:, 0], white[:, 1])
        root = np.sqrt(robust_weights(norm / scale)) / scale
        scale, before = robust_scale(norm), scale
        drawn = precision * (start.parameters - fitted.lens.parameters)[free]
        step, pose_steps, length = _solved(
            jacobian * root[:, None, None], white * root[:, None], data.first, precision, drawn
        )
        whole = np.zeros(start.size)
        whole[free] = step
        moved = (p.perturbed(d) for p, d in zip(fitted.poses, pose_steps, strict=True))
        fitted = FittedLens(fitted.lens.moved(whole), tuple(moved))
        if not fitted.sound:
            raise np.linalg.LinAlgError
        if length < _SETTLED_SIGMAS and abs(scale - before) < _SETTLED_SCALE * before:
            break
    return fitted


@dataclass(frozen=True, slots=True)
class _Corners:
    """The corners of all views, one after another."""

    points_mm: FloatArray
    """(n, 3) on the board."""
    points_px: FloatArray
    whitening: FloatArray
    view: IntArray
    """(n,) which view each is of."""
    first: list[int]
    """(views + 1,) where each view begins."""

    @classmethod
    def of(cls, corners_mm: FloatArray, views: Sequence[BoardView]) -> _Corners:
        counts = [len(view.index) for view in views]
        return cls(
            np.concatenate([corners_mm[view.index] for view in views]),
            np.concatenate([view.points_px for view in views]),
            np.concatenate([view.whitening() for view in views]),
            np.repeat(np.arange(len(views)), counts),
            [0, *np.cumsum(counts).tolist()],
        )

    def linearised(self, fitted: FittedLens, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """Whitened d(px)/d(free lens parameters, pose) (n, 2, free + 6) and residuals (n, 2)."""
        turns = np.array([pose.R for pose in fitted.poses])[self.view]
        shifts = np.array([pose.t_mm for pose in fitted.poses])[self.view]
        rotated = (turns @ self.points_mm[:, :, None])[:, :, 0]
        px, by_point, by_lens = fitted.lens.project_jacobians(rotated + shifts)
        by_turn = -by_point @ skew_matrix(rotated)
        jacobian = np.concatenate([by_lens[:, :, free], by_turn, by_point], axis=2)
        white = (self.whitening @ (self.points_px - px)[:, :, None])[:, :, 0]
        return self.whitening @ jacobian, white


def _solved(
    jacobian: FloatArray,
    white: FloatArray,
    first: list[int],
    precision: FloatArray,
    drawn: FloatArray,
) -> tuple[FloatArray, list[FloatArray], float]:
    """Steps of the lens and of each pose, and the length of the lens's step in sigmas."""
    m = jacobian.shape[2] - 6
    lens, right, views = np.diag(precision), drawn.copy(), []
    for begin, end in pairwise(first):
        flat = jacobian[begin:end].reshape(-1, m + 6)
        normal, gain = flat.T @ flat, flat.T @ white[begin:end].ravel()
        solved = np.linalg.solve(normal[m:, m:], np.column_stack([normal[m:, :m], gain[m:]]))
        lens += normal[:m, :m] - normal[:m, m:] @ solved[:, :m]
        right += gain[:m] - normal[:m, m:] @ solved[:, m]
        views.append(solved)
    unit = 1.0 / np.sqrt(np.diag(lens))
    step = unit * np.linalg.solve(lens * unit[:, None] * unit, right * unit)
    length = float(np.sqrt(max(float(right @ step), 0.0)))
    return step, [solved[:, m] - solved[:, :m] @ step for solved in views], length
