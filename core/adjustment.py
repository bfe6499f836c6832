"""One joint adjustment of lens, board, poses and rig over all calibration views.

Unknowns: the lens (core.lens), the board's shape (two print scales, shear, a bow of fourth
degree, and an in-plane offset of every corner), the pose of every view, and the rig. Priors
keep what the views do not determine at what the survey says; the nominal board is a prior too.
The corner offsets, some thousand, are eliminated corner by corner (Schur complement), so that a
step solves a dense system of a few hundred unknowns.
Source: Lee et al. (2020) Eq. 10-12 for the sub-camera; the rest is bundle adjustment after
Triggs et al., "Bundle adjustment - a modern synthesis" (2000), section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from core.board import Board
from core.lens import Lens
from core.pose import Pose
from core.resection import BoardView, pose_jacobian, robust_scale, robust_weights
from core.rig import RIG_PARAMETERS, MainView, Rig, rig_residuals
from core.site import FloatArray

SHAPE_PARAMETERS = 13


@dataclass(frozen=True, slots=True)
class AdjustmentPriors:
    """1-sigma priors; 0 keeps the parameter where it is."""

    lens: FloatArray
    """(lens parameters,) about the start values, in the lens's units."""
    scale: float = 1.0e-3
    """Print scale in x and y, and shear."""
    bow_mm: tuple[float, float, float] = (0.1, 0.03, 0.03)
    """Bow terms of second, third and fourth degree at the board's edge."""
    corner_mm: float = 0.01
    """In-plane offset of each corner; 0 for a perfect board."""
    rig: FloatArray = field(default_factory=lambda: np.zeros(RIG_PARAMETERS))
    """(8,) about the rig as drawn, see core.rig."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The state of the adjustment, and its covariance once solved."""

    lens: Lens
    shape: FloatArray
    """(13,) scale x, scale y, shear, bow terms (see `shape_terms`)."""
    offsets_mm: FloatArray
    """(corners, 2)."""
    poses: tuple[Pose, ...]
    rig: Rig | None
    corners_mm: FloatArray
    """(corners, 3) the board as estimated."""
    covariance: FloatArray
    """Of lens, shape, rig and the first pose, in this order: (its size + 13 + 8 + 6) square.

    The first pose is what is left of it once the errors of lens and board have had their effect
    on a pose fitted to its image: those turn all poses nearly alike, and only differences of
    poses are ever used.
    """
    scale: float
    """Ratio of the residuals to their predicted size."""
    view_rms_px: tuple[float, ...]
    view_kept: tuple[float, ...]
    """Mean weight of each view's corners: 1 where all fit."""
    main_rms_px: float


def shape_terms(board: Board) -> FloatArray:
    """d(corner)/d(shape) (corners, 3, 13): scale x, scale y, shear, then ten terms of bow."""
    flat = board.corners_mm
    centre = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    x, y = (flat - centre)[:, 0], (flat - centre)[:, 1]
    half = max(float(np.abs(x).max()), float(np.abs(y).max()))
    p, q = x / half, y / half
    terms = np.zeros((len(flat), 3, SHAPE_PARAMETERS))
    terms[:, 0, 0], terms[:, 1, 1] = x, y
    terms[:, 0, 2] = y
    bow = [p * p, p * q, q * q, p**3, p * p * q, p * q * q, q**3, p**4, p * p * q * q, q**4]
    terms[:, 2, 3:] = np.stack(bow, axis=1)
    return terms


def _shape_sigmas(priors: AdjustmentPriors) -> FloatArray:
    second, third, fourth = priors.bow_mm
    return np.array([priors.scale] * 3 + [second] * 3 + [third] * 4 + [fourth] * 3)


def _build_board(board: Board, shape: FloatArray, offsets: FloatArray) -> FloatArray:
    corners = board.corners_mm + shape_terms(board) @ shape
    corners[:, :2] += offsets
    return corners


def pose_sensitivity(
    lens: Lens,
    pose: Pose,
    corners_mm: FloatArray,
    terms: FloatArray,
    view: BoardView,
    root: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """How a pose fitted to located corners follows lens and board.

    The pose is where J^T W (u - f) = 0, so it moves by -(J^T W J)^-1 J^T W df/dx. Gives that by
    lens and shape (6, its size + 13) and by the corners' offsets (6, n, 2). root (n, 2, 2) whitens.
    """
    _, by_pose, by_point, by_lens = pose_jacobian(lens, pose, corners_mm[view.index])
    flat = (root @ by_pose).reshape(-1, 6)
    by_shape = by_point @ terms[view.index]
    rest = (root @ np.concatenate([by_lens, by_shape], axis=2)).reshape(len(flat), -1)
    normal = flat.T @ flat
    weighted = (root @ by_pose).transpose(0, 2, 1) @ root @ by_point[:, :, :2]
    by_offset = -np.linalg.solve(normal, weighted.transpose(1, 0, 2).reshape(6, -1))
    return -np.linalg.solve(normal, flat.T @ rest), by_offset.reshape(6, -1, 2)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where each group of unknowns stands in the dense system."""

    lens_size: int
    views: int

    @property
    def lens(self) -> slice:
        return slice(0, self.lens_size)

    @property
    def shape(self) -> slice:
        return slice(self.lens_size, self.lens_size + SHAPE_PARAMETERS)

    @property
    def rig(self) -> slice:
        start = self.lens_size + SHAPE_PARAMETERS
        return slice(start, start + RIG_PARAMETERS)

    def pose(self, view: int) -> slice:
        start = self.lens_size + SHAPE_PARAMETERS + RIG_PARAMETERS + 6 * view
        return slice(start, start + 6)

    @property
    def size(self) -> int:
        return self.lens_size + SHAPE_PARAMETERS + RIG_PARAMETERS + 6 * self.views


def adjust(
    board: Board,
    views: Sequence[BoardView],
    start_lens: Lens,
    start_poses: Sequence[Pose],
    priors: AdjustmentPriors,
    start_rig: Rig | None = None,
    main_views: Sequence[MainView | None] = (),
    iterations: int = 25,
) -> Adjusted:
    """Adjust everything to all views.

    The first view is the reference if there is a rig; main_views[v] holds the main camera's
    discs of view v, or None. Raises numpy.linalg.LinAlgError if the views determine too little.
    """
    state = Adjusted(
        start_lens,
        np.zeros(SHAPE_PARAMETERS),
        np.zeros((len(board.corners_mm), 2)),
        tuple(start_poses),
        start_rig,
        board.corners_mm.copy(),
        np.zeros((0, 0)),
        1.0,
        (),
        (),
        0.0,
    )
    problem = _Problem(board, views, start_lens, start_rig, priors, main_views)
    scale = 30.0  # start tolerant, then let the weights tighten as the fit gets good
    for _ in range(iterations):
        system = problem.linearise(state, scale)
        step, offset_step = system.solve()
        state = problem.step(state, step, offset_step)
        settled = float(np.abs(step / problem.step_unit).max()) < 1e-3
        if settled and abs(system.scale - scale) < 1e-3 * scale:
            break
        scale = system.scale
    system = problem.linearise(state, scale)
    return replace(
        state,
        covariance=problem.covariance(state, system),
        scale=system.scale,
        view_rms_px=tuple(system.view_rms),
        view_kept=tuple(system.view_kept),
        main_rms_px=system.main_rms,
    )


@dataclass(slots=True)
class _System:
    """Normal equations, the corner offsets still apart."""

    dense: FloatArray
    right: FloatArray
    cross: FloatArray
    """(corners, 2, size)."""
    corner: FloatArray
    """(corners, 2, 2)."""
    corner_right: FloatArray
    """(corners, 2)."""
    scale: float = 1.0
    view_rms: list[float] = field(default_factory=list)
    view_kept: list[float] = field(default_factory=list)
    main_rms: float = 0.0

    def reduced(self) -> FloatArray:
        """The dense normal matrix with the corner offsets eliminated."""
        weighted = np.linalg.solve(self.corner, self.cross)
        size = len(self.dense)
        flat, weighted_flat = self.cross.reshape(-1, size), weighted.reshape(-1, size)
        return self.dense - flat.T @ weighted_flat

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Step of the dense unknowns and of the corner offsets."""
        inverse_right = np.linalg.solve(self.corner, self.corner_right[:, :, None])[:, :, 0]
        right = self.right - np.einsum("cas,ca->s", self.cross, inverse_right)
        reduced = self.reduced()
        unit = 1.0 / np.sqrt(np.diag(reduced))
        step = unit * np.linalg.solve(reduced * unit[:, None] * unit, right * unit)
        rest = self.corner_right - self.cross @ step
        return step, np.linalg.solve(self.corner, rest[:, :, None])[:, :, 0]


class _Problem:
    """What stays the same over the iterations."""

    def __init__(
        self,
        board: Board,
        views: Sequence[BoardView],
        start_lens: Lens,
        start_rig: Rig | None,
        priors: AdjustmentPriors,
        main_views: Sequence[MainView | None],
    ) -> None:
        self.board, self.views, self.priors = board, views, priors
        self.start_lens, self.start_rig, self.main_views = start_lens, start_rig, main_views
        self.whitening = [view.whitening() for view in views]
        self.terms = shape_terms(board)
        self.layout = _Layout(start_lens.size, len(views))
        layout = self.layout
        sigma = np.full(layout.size, np.inf)
        sigma[layout.lens], sigma[layout.shape] = priors.lens, _shape_sigmas(priors)
        sigma[layout.rig] = priors.rig
        self.sigma = sigma
        self.step_unit = np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0) * 1e-3

    def linearise(self, state: Adjusted, scale: float) -> _System:
        size, corners = self.layout.size, len(self.board.corners_mm)
        system = _System(
            np.zeros((size, size)),
            np.zeros(size),
            np.zeros((corners, 2, size)),
            np.zeros((corners, 2, 2)),
            np.zeros((corners, 2)),
        )
        norms = [self._add_board_view(system, state, v, scale) for v in range(len(self.views))]
        system.scale = robust_scale(np.concatenate(norms))
        self._add_main_views(system, state)
        self._add_priors(system, state)
        return system

    def _add_board_view(self, system: _System, state: Adjusted, v: int, scale: float) -> FloatArray:
        """Add one view's corners; their whitened residual norms come back."""
        view, layout = self.views[v], self.layout
        projected, by_pose, by_point, by_lens = pose_jacobian(
            state.lens, state.poses[v], state.corners_mm[view.index]
        )
        residual = view.points_px - projected
        white = (self.whitening[v] @ residual[:, :, None])[:, :, 0]
        norm = np.hypot(white[:, 0], white[:, 1])
        weights = robust_weights(norm / scale)
        whiten = self.whitening[v] * np.sqrt(weights)[:, None, None]
        white *= np.sqrt(weights)[:, None]
        by_shape = by_point @ self.terms[view.index]
        local = whiten @ np.concatenate([by_lens, by_shape, by_pose], axis=2)
        by_offset = whiten @ by_point[:, :, :2]
        columns = np.r_[layout.lens, layout.shape, layout.pose(v)]
        flat = local.reshape(-1, len(columns))
        system.dense[np.ix_(columns, columns)] += flat.T @ flat
        system.right[columns] += flat.T @ white.ravel()
        turned = by_offset.transpose(0, 2, 1)
        system.cross[view.index[:, None, None], np.arange(2)[:, None], columns] += turned @ local
        system.corner[view.index] += turned @ by_offset
        system.corner_right[view.index] += (turned @ white[:, :, None])[:, :, 0]
        squares = weights * (residual**2).sum(axis=1) / 2.0
        system.view_kept.append(float(weights.mean()))
        system.view_rms.append(float(np.sqrt(squares.sum() / weights.sum())))
        return norm

    def _add_main_views(self, system: _System, state: Adjusted) -> None:
        if state.rig is None:
            return
        squares, count, layout = 0.0, 0, self.layout
        for v, main in enumerate(self.main_views):
            if v == 0 or main is None:
                continue
            residual, by_rig, by_pose, by_reference = rig_residuals(
                state.rig, main, state.poses[v], state.poses[0]
            )
            squares, count = squares + float((residual**2).sum()), count + residual.size
            norm = np.hypot(residual[:, 0], residual[:, 1]) / main.sigma_px
            root = np.sqrt(robust_weights(norm / max(1.0, float(np.median(norm)))))
            root = root[:, None] / main.sigma_px * system.scale
            columns = np.r_[layout.rig, layout.pose(v), layout.pose(0)]
            local = np.concatenate([by_rig, by_pose, by_reference], axis=2) * root[:, :, None]
            flat = local.reshape(-1, len(columns))
            system.dense[np.ix_(columns, columns)] += flat.T @ flat
            system.right[columns] += flat.T @ (residual * root).ravel()
        system.main_rms = float(np.sqrt(squares / count)) if count else 0.0

    def _add_priors(self, system: _System, state: Adjusted) -> None:
        layout = self.layout
        deviation = np.zeros(layout.size)
        deviation[layout.lens] = self.start_lens.parameters - state.lens.parameters
        deviation[layout.shape] = -state.shape
        if state.rig is not None and self.start_rig is not None:
            deviation[layout.rig] = state.rig.deviation_from(self.start_rig)
        # The corners' residuals are weighted by their predicted size; priors are in true units.
        weight = np.where(self.sigma > 0, system.scale**2 / np.maximum(self.sigma, 1e-12) ** 2, 0.0)
        system.dense[np.diag_indices(layout.size)] += weight
        system.right += weight * deviation
        fixed = self.sigma == 0
        system.dense[fixed, :] = 0.0
        system.dense[:, fixed] = 0.0
        system.dense[fixed, fixed] = 1e12
        system.right[fixed] = 0.0
        system.cross[:, :, fixed] = 0.0
        corner_sigma = max(self.priors.corner_mm, 1e-9)
        system.corner += np.eye(2) * (system.scale / corner_sigma) ** 2
        system.corner_right -= state.offsets_mm * (system.scale / corner_sigma) ** 2

    def covariance(self, state: Adjusted, system: _System) -> FloatArray:
        """Covariance of lens, shape, rig and first pose, see `Adjusted.covariance`.

        With S the reduced normal matrix, C and X the corner and cross blocks, and y = A d + B o
        of dense unknowns d and offsets o: cov y = (A - B C^-1 X) S^-1 (..)^T + B C^-1 B^T.
        """
        layout, view = self.layout, self.views[0]
        first = layout.pose(0)
        by_lens_shape, by_offset = pose_sensitivity(
            state.lens, state.poses[0], state.corners_mm, self.terms, view, self.whitening[0]
        )
        through = np.linalg.solve(system.corner[view.index], by_offset.transpose(1, 2, 0))
        transform = np.eye(first.stop, layout.size)
        transform[first, : layout.shape.stop] -= by_lens_shape
        transform[first] += np.einsum("nci,ncs->is", through, system.cross[view.index])
        reduced = system.reduced()
        unit = 1.0 / np.sqrt(np.diag(reduced))
        scaled = np.linalg.inv(reduced * unit[:, None] * unit)
        covariance = (transform * unit) @ scaled @ (transform * unit).T
        covariance[first, first] += np.einsum("inc,ncj->ij", by_offset, through)
        return np.asarray(covariance * system.scale**2)

    def step(self, state: Adjusted, step: FloatArray, offset_step: FloatArray) -> Adjusted:
        layout = self.layout
        shape = state.shape + step[layout.shape]
        offsets = state.offsets_mm + offset_step
        return replace(
            state,
            lens=state.lens.moved(step[layout.lens]),
            shape=shape,
            offsets_mm=offsets,
            poses=tuple(pose.perturbed(step[layout.pose(v)]) for v, pose in enumerate(state.poses)),
            rig=None if state.rig is None else state.rig.perturbed(step[layout.rig]),
            corners_mm=_build_board(self.board, shape, offsets),
        )
