"""The normal equations of the adjustment: what each view and prior adds, and their inverse.

The corners' own offsets, some thousand, are eliminated corner by corner (Schur complement), so
that a step solves a dense system of a few hundred unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from core.adjustment.view_kernels import add_corners
from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.board_shape import SHAPE_PARAMETERS, shape_sigmas
from core.checkerboard.pose_kernels import whiten_residuals
from core.checkerboard.resection import BoardView, robust_scale, robust_weights
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.rig.posterior import Posterior
from core.rig.rigid import RIG_PARAMETERS, MainView, Rig, rig_residuals

_FIXED = 1e12
"""Information on a parameter that is kept where it is: more than any view gives, and solvable."""
_LEAST_SIGMA = 1e-12
"""So that a sigma of 0 (kept) does not divide by zero before it is replaced."""
_LEAST_CORNER_MM = 1e-9
"""1 sigma that keeps corners on their lines."""
_LEAST_FREEDOM = 0.5
"""Degrees of freedom over residuals, at least: below it the views are too few to say."""


@dataclass(frozen=True, slots=True)
class AdjustmentPriors:
    """1-sigma priors; 0 keeps the parameter where it is."""

    lens: FloatArray
    """(lens parameters,) about the start values, in the lens's units."""
    square: float = math.inf
    """Of alpha / beta about 1, relative: how square the pixels are taken to be."""
    scale: float = 1.0e-3
    """Print scale in x and y, and shear."""
    bow_mm: tuple[float, float, float] = (0.1, 0.03, 0.03)
    """Bow terms of second, third and fourth degree at the board's edge."""
    line_mm: float = 0.01
    """Place of each printed line: where the estimate of this spread starts; 0 for perfect ones."""
    corner_mm: float = 0.01
    """In-plane offset of each corner from its lines, likewise."""
    rig: FloatArray = field(default_factory=lambda: np.zeros(RIG_PARAMETERS))
    """(8,) about the rig as drawn, see core.rig.rigid."""
    discs_px: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(discs,) of a coordinate in the reference's main image; 0 for a disc not seen there."""


@dataclass(frozen=True, slots=True)
class PrintSpread:
    """1-sigma departures of a print from the nominal board; 0 keeps them nominal."""

    column_mm: float
    """x of each column of corners, as one."""
    row_mm: float
    """y of each row."""
    corner_mm: float
    """x and y of each corner, beyond its column and row."""

    def agrees_with(self, other: PrintSpread, share: float) -> bool:
        """Whether all agree to this share."""
        mine = np.array([self.column_mm, self.row_mm, self.corner_mm])
        theirs = np.array([other.column_mm, other.row_mm, other.corner_mm])
        return bool(np.all(np.abs(mine - theirs) <= share * mine))


@dataclass(frozen=True, slots=True)
class AdjustmentState:
    """Where the adjustment stands."""

    lens: Lens
    shape: FloatArray
    """(13 + columns + rows,) in the order of `core.checkerboard.board_shape.board_terms`."""
    offsets_mm: FloatArray
    """(corners, 2)."""
    poses: tuple[Pose, ...]
    rig: Rig | None
    corners_mm: FloatArray
    """(corners, 3) the board as estimated."""
    discs_px: FloatArray
    """(discs, 2) what the reference's main image has to be corrected by: its own noise."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where each group of unknowns stands in the dense system."""

    lens_size: int
    shape_size: int
    discs: int
    views: int

    @property
    def lens(self) -> slice:
        return slice(0, self.lens_size)

    @property
    def shape(self) -> slice:
        return slice(self.lens_size, self.lens_size + self.shape_size)

    @property
    def lines(self) -> slice:
        return slice(self.lens_size + SHAPE_PARAMETERS, self.shape.stop)

    @property
    def rig(self) -> slice:
        return slice(self.shape.stop, self.shape.stop + RIG_PARAMETERS)

    @property
    def all_discs(self) -> slice:
        return slice(self.rig.stop, self.rig.stop + 2 * self.discs)

    def pose(self, view: int) -> slice:
        start = self.all_discs.stop + 6 * view
        return slice(start, start + 6)

    @property
    def size(self) -> int:
        return int(self.all_discs.stop + 6 * self.views)


@dataclass(slots=True)
class NormalEquations:
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
        root = np.linalg.inv(np.linalg.cholesky(self.corner))
        halves = (root @ self.cross).reshape(-1, len(self.dense))
        return self.dense - halves.T @ halves

    def solve(self) -> tuple[FloatArray, FloatArray, float]:
        """Step of the dense unknowns and of the corner offsets, and its length in sigmas."""
        inverse_right = np.linalg.solve(self.corner, self.corner_right[:, :, None])[:, :, 0]
        right = self.right - np.einsum("cas,ca->s", self.cross, inverse_right)
        reduced = self.reduced()
        unit = 1.0 / np.sqrt(np.diag(reduced))
        step = unit * np.linalg.solve(reduced * unit[:, None] * unit, right * unit)
        rest = self.corner_right - self.cross @ step
        offsets = np.linalg.solve(self.corner, rest[:, :, None])[:, :, 0]
        gain = float(right @ step) + float((self.corner_right * inverse_right).sum())
        return step, offsets, float(np.sqrt(max(gain, 0.0))) / self.scale

    def factor(self) -> FloatArray:
        """F (size, size) with F F^T the covariance of the dense unknowns."""
        reduced = self.reduced()
        unit = 1.0 / np.sqrt(np.diag(reduced))
        root = np.linalg.cholesky(reduced * unit[:, None] * unit)
        inverse = np.linalg.solve(root, np.eye(len(root)))
        return np.asarray(self.scale * unit[:, None] * inverse.T)


class AdjustmentProblem:
    """What stays the same over the iterations."""

    def __init__(
        self,
        board: Board,
        terms: FloatArray,
        views: Sequence[BoardView],
        start: AdjustmentState,
        priors: AdjustmentPriors,
        main_views: Sequence[MainView | None],
    ) -> None:
        self.board, self.terms, self.views, self.start = board, terms, views, start
        self.shape_terms = np.ascontiguousarray(terms[:, :, :SHAPE_PARAMETERS])
        self.main_views, self.square = main_views, priors.square
        self.whitening = [view.whitening() for view in views]
        self.layout = _Layout(start.lens.size, terms.shape[2], len(priors.discs_px), len(views))
        layout = self.layout
        sigma = np.full(layout.size, np.inf)
        sigma[layout.lens], sigma[layout.rig] = priors.lens, priors.rig
        sigma[layout.all_discs] = np.repeat(priors.discs_px, 2)
        shape = shape_sigmas(priors.scale, priors.bow_mm)
        lines = np.full(terms.shape[2] - len(shape), priors.line_mm)
        sigma[layout.shape] = np.concatenate([shape, lines])
        self.sigma = sigma

    def linearise(
        self, state: AdjustmentState, scale: float, spreads: PrintSpread, noise: float | None = None
    ) -> NormalEquations:
        """Sum up what all views and priors say about a step from this state.

        noise is the ratio of errors to their predicted size; None estimates it.
        """
        size, corners = self.layout.size, len(self.board.corners_mm)
        system = NormalEquations(
            np.zeros((size, size)),
            np.zeros(size),
            np.zeros((corners, 2, size)),
            np.zeros((corners, 2, 2)),
            np.zeros((corners, 2)),
        )
        norms = [self._add_board_view(system, state, v, scale) for v in range(len(self.views))]
        if noise is None:
            noise = robust_scale(np.concatenate(norms)) * self._freedom()
        system.scale = noise
        self._add_lines(system)
        self._add_main_views(system, state)
        self._add_priors(system, state, spreads)
        return system

    def _freedom(self) -> float:
        """How much larger errors are than the residuals that a fit of so many unknowns leaves."""
        residuals = 2 * sum(len(view.index) for view in self.views)
        seen = len(np.unique(np.concatenate([view.index for view in self.views])))
        unknowns = self.layout.size + 2 * seen
        return float(np.sqrt(residuals / max(residuals - unknowns, _LEAST_FREEDOM * residuals)))

    def _add_board_view(
        self, system: NormalEquations, state: AdjustmentState, v: int, scale: float
    ) -> FloatArray:
        """Add one view's corners; their whitened residual norms come back."""
        view, layout = self.views[v], self.layout
        R = np.ascontiguousarray(state.poses[v].R)
        rotated = state.corners_mm[view.index] @ R.T
        in_camera = rotated + state.poses[v].t_mm
        projected, by_point, by_lens = state.lens.project_jacobians(in_camera)
        residual, whiten = view.points_px - projected, self.whitening[v]
        white, norm = np.empty_like(residual), np.empty(len(residual))
        whiten_residuals(residual, whiten, white, norm)
        weights = robust_weights(norm / scale)
        pose, shared = layout.pose(v), layout.lines.start
        flat, rest = np.empty((residual.size, shared + 6)), np.empty(residual.size)
        add_corners(
            *(view.index, whiten, white, weights, by_lens, by_point, rotated, R),
            *(self.shape_terms, pose.start, flat, rest),
            *(system.cross, system.corner, system.corner_right),
        )
        columns = np.r_[:shared, pose]
        system.dense[np.ix_(columns, columns)] += flat.T @ flat
        system.right[columns] += flat.T @ rest
        squares = weights * (residual**2).sum(axis=1) / 2.0
        system.view_kept.append(float(weights.mean()))
        system.view_rms.append(float(np.sqrt(squares.sum() / weights.sum())))
        return norm

    def _add_lines(self, system: NormalEquations) -> None:
        """What the views say of a line is what they say of the offsets of all corners on it."""
        lines, size = self.layout.lines, self.layout.size
        along = self.terms[:, :2, SHAPE_PARAMETERS:]
        system.cross[:, :, lines] = system.corner @ along
        flat = along.reshape(-1, along.shape[2])
        system.dense[lines] = flat.T @ system.cross.reshape(-1, size)
        system.dense[:, lines] = system.dense[lines].T
        system.right[lines] = flat.T @ system.corner_right.ravel()

    def _add_main_views(self, system: NormalEquations, state: AdjustmentState) -> None:
        if state.rig is None:
            return
        layout, seen = self.layout, []
        for v, main in enumerate(self.main_views):
            if v > 0 and main is not None:
                shifted = replace(main, reference_px=main.reference_px + state.discs_px[main.which])
                parts = rig_residuals(state.rig, shifted, state.poses[v], state.poses[0])
                seen.append((v, main, *parts))
        if not seen:
            return
        norms = [np.hypot(*residual.T) / main.sigma_px for _, main, residual, *_ in seen]
        scale = max(1.0, robust_scale(np.concatenate(norms)))  # poses take up some of it
        system.main_rms = float(np.sqrt(np.mean(np.concatenate([part[2] for part in seen]) ** 2)))
        for (v, main, residual, by_rig, by_pose, by_reference), norm in zip(
            seen, norms, strict=True
        ):
            root = np.sqrt(robust_weights(norm / scale)) / (main.sigma_px * scale) * system.scale
            discs = layout.all_discs.start + 2 * main.which[:, None] + np.arange(2)
            columns = np.r_[layout.rig, layout.pose(v), layout.pose(0), discs.ravel()]
            # A disc's place moves with its place in the reference, to a part in a thousand.
            by_discs = np.eye(discs.size).reshape(len(discs), 2, -1)
            local = np.concatenate([by_rig, by_pose, by_reference, by_discs], axis=2)
            flat = (local * root[:, None, None]).reshape(-1, len(columns))
            system.dense[np.ix_(columns, columns)] += flat.T @ flat
            system.right[columns] += flat.T @ (residual * root[:, None]).ravel()

    def _add_priors(
        self, system: NormalEquations, state: AdjustmentState, spreads: PrintSpread
    ) -> None:
        layout = self.layout
        deviation = np.zeros(layout.size)
        deviation[layout.lens] = self.start.lens.parameters - state.lens.parameters
        deviation[layout.shape] = -state.shape
        deviation[layout.all_discs] = -state.discs_px.ravel()
        if state.rig is not None and self.start.rig is not None:
            deviation[layout.rig] = state.rig.deviation_from(self.start.rig)
        sigma = self.sigma.copy()
        columns = self.board.columns
        sigma[layout.lines][:columns] = spreads.column_mm
        sigma[layout.lines][columns:] = spreads.row_mm
        self._add_square_pixels(system, state.lens)
        # The corners' residuals are weighted by their predicted size; priors are in true units.
        weight = np.where(sigma > 0, system.scale**2 / np.maximum(sigma, _LEAST_SIGMA) ** 2, 0.0)
        system.dense[np.diag_indices(layout.size)] += weight
        system.right += weight * deviation
        fixed = sigma == 0
        system.dense[fixed, :] = 0.0
        system.dense[:, fixed] = 0.0
        system.dense[fixed, fixed] = _FIXED
        system.right[fixed] = 0.0
        system.cross[:, :, fixed] = 0.0
        corner_sigma = max(spreads.corner_mm, _LEAST_CORNER_MM)
        system.corner += np.eye(2) * (system.scale / corner_sigma) ** 2
        system.corner_right -= state.offsets_mm * (system.scale / corner_sigma) ** 2

    def _add_square_pixels(self, system: NormalEquations, lens: Lens) -> None:
        alpha, beta = lens.parameters[:2]
        slope = np.array([1.0, -1.0]) / beta * system.scale / self.square
        system.dense[:2, :2] += np.outer(slope, slope)
        system.right[:2] -= slope * (alpha / beta - 1.0) * system.scale / self.square

    def line_variance(self, system: NormalEquations) -> FloatArray:
        """(columns + rows,) mm^2, of the lines' places."""
        return np.asarray((system.factor()[self.layout.lines] ** 2).sum(axis=1))

    def posterior(self, system: NormalEquations) -> Posterior:
        """The joint covariance of lens, rig, first pose and corners.

        With F the factor of the dense unknowns, X and C the cross and corner blocks, the offsets
        are -C^-1 X F and an own part of covariance C^-1; the corners are these and the shape.
        """
        layout = self.layout
        factor = system.factor()
        size, own = len(factor), np.linalg.inv(system.corner)
        corners = self.terms.reshape(-1, self.terms.shape[2]) @ factor[layout.shape]
        corners = corners.reshape(-1, 3, size)
        crossed = system.cross.reshape(-1, size) @ factor
        corners[:, :2] -= own @ crossed.reshape(-1, 2, size)
        discs = factor[layout.all_discs].reshape(layout.discs, 2, factor.shape[1])
        return Posterior(
            *(factor[layout.lens], factor[layout.rig], factor[layout.pose(0)], discs, corners),
            own * system.scale**2,
        )

    def step(
        self, state: AdjustmentState, step: FloatArray, offset_step: FloatArray
    ) -> AdjustmentState:
        """The state after a step."""
        layout = self.layout
        shape = state.shape + step[layout.shape]
        offsets = state.offsets_mm + offset_step
        corners = self.board.corners_mm + self.terms @ shape
        corners[:, :2] += offsets
        return AdjustmentState(
            state.lens.moved(step[layout.lens]),
            shape,
            offsets,
            tuple(pose.perturbed(step[layout.pose(v)]) for v, pose in enumerate(state.poses)),
            None if state.rig is None else state.rig.perturbed(step[layout.rig]),
            corners,
            state.discs_px + step[layout.all_discs].reshape(-1, 2),
        )
