"""One joint adjustment of lens, board, poses and rig over all calibration views.

Unknowns: the lens (core.geometry.lens), the board's shape (two print scales, shear, a bow of fourth
degree, the place of every printed line and of every corner, see core.checkerboard.board_shape), the
pose of every view, and the rig. Priors keep what the views do not determine at what the survey
says; the nominal board is a prior too. How far lines and corners are from it is estimated
with them. Source: Lee et al. (2020) Eq. 10-12 for the sub-camera; the rest is bundle adjustment
after Triggs et al., "Bundle adjustment - a modern synthesis" (2000), section 6; the estimate of the
spreads is that of MacKay, "Bayesian interpolation" (1992), section 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from core.adjustment.normal_equations import (
    AdjustmentPriors,
    AdjustmentProblem,
    AdjustmentState,
    NormalEquations,
    PrintSpread,
)
from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.board_shape import SHAPE_PARAMETERS, board_terms
from core.checkerboard.resection import BoardView
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.rig.posterior import Posterior
from core.rig.rigid import MainView, Rig

_START_SCALE = 30.0
"""Residuals over their predicted size, at the start: no corner is down-weighted while the fit is
still that bad."""
_WORSE = 2.0
"""Residuals that grow by this factor are the step's fault, not outliers."""
_SETTLED_SCALE, _SETTLED_SIGMAS, _SETTLED_SPREAD = 1e-3, 0.02, 0.03
"""Changes after which the fit stops: of the residuals' scale, relative; of the parameters, in their
sigmas; of the print's spreads, relative."""
_LEAST_LINE_MM, _LEAST_CORNER_MM = 3e-4, 5e-5
"""1 sigma of a print at least, so that a perfect one does not fix its own corners."""
_PRIOR_LINES, _PRIOR_LINE_MM = 2.0, 5e-3
"""A board has few lines: their spread counts so many more lines of a fair print's spread."""
_ITERATIONS = 40
"""At most; the limits above stop it before."""


@dataclass(frozen=True, slots=True)
class AdjustmentResult:
    """The result of the adjustment."""

    lens: Lens
    shape: FloatArray
    """(13,) scale x, scale y, shear, bow terms (see core.checkerboard.board_shape)."""
    poses: tuple[Pose, ...]
    rig: Rig | None
    corners_mm: FloatArray
    """(corners, 3) the board as estimated."""
    discs_px: FloatArray
    """(discs, 2) correction of the discs' places in the reference, by all other views."""
    posterior: Posterior
    """Of lens, rig, first pose, the reference's discs and corners."""
    spreads: PrintSpread
    """How far this board's lines and corners are from the nominal ones."""
    scale: float
    """Ratio of the residuals to their predicted size."""
    view_rms_px: tuple[float, ...]
    view_kept: tuple[float, ...]
    """Mean weight of each view's corners: 1 where all fit."""
    main_rms_px: float


def adjust(
    board: Board,
    views: Sequence[BoardView],
    start_lens: Lens,
    start_poses: Sequence[Pose],
    priors: AdjustmentPriors,
    start_rig: Rig | None = None,
    main_views: Sequence[MainView | None] = (),
    iterations: int = _ITERATIONS,
) -> AdjustmentResult:
    """Adjust everything to all views.

    The first view is the reference if there is a rig; main_views[v] holds the main camera's
    discs of view v, or None. Raises numpy.linalg.LinAlgError if the views determine too little.
    """
    problem, state = _begin(board, views, start_lens, start_poses, priors, start_rig, main_views)
    spreads = PrintSpread(priors.line_mm, priors.line_mm, priors.corner_mm)
    scale = _START_SCALE  # at first, then let the weights tighten as the fit gets good
    for _ in range(iterations):
        system = problem.linearise(state, scale, spreads)
        if system.scale > _WORSE * scale:  # the step went too far: these are no outliers
            system = problem.linearise(state, system.scale, spreads)
        step, offset_step, sigmas = system.solve()
        state = problem.step(state, step, offset_step)
        if sigmas < _SETTLED_SIGMAS and abs(system.scale - scale) < _SETTLED_SCALE * scale:
            renewed = _renewed(spreads, problem, state, system, board.columns)
            if spreads.agrees_with(renewed, _SETTLED_SPREAD):
                break
            spreads = renewed
        scale = system.scale
    return _adjusted(problem, state, spreads, problem.linearise(state, scale, spreads))


def predict_adjustment(
    board: Board,
    views: Sequence[BoardView],
    lens: Lens,
    poses: Sequence[Pose],
    priors: AdjustmentPriors,
    rig: Rig | None,
    main_views: Sequence[MainView | None],
    spreads: PrintSpread,
) -> AdjustmentResult:
    """Say what the adjustment will know where lens, poses and rig are these: nothing is fitted.

    The views are those places in the images, free of noise, with the covariance that located
    ones will have; spreads are those of the print to come.
    """
    problem, state = _begin(board, views, lens, poses, priors, rig, main_views)
    system = problem.linearise(state, 1.0, spreads, noise=1.0)
    system.view_rms = [float(np.sqrt(np.mean(v.covariance_px2[:, [0, 1], [0, 1]]))) for v in views]
    return _adjusted(problem, state, spreads, system)


def _begin(
    board: Board,
    views: Sequence[BoardView],
    lens: Lens,
    poses: Sequence[Pose],
    priors: AdjustmentPriors,
    rig: Rig | None,
    main_views: Sequence[MainView | None],
) -> tuple[AdjustmentProblem, AdjustmentState]:
    """Set up the problem, and the state it starts from: the nominal board."""
    terms = board_terms(board)
    state = AdjustmentState(
        lens,
        np.zeros(terms.shape[2]),
        np.zeros((len(board.corners_mm), 2)),
        tuple(poses),
        rig,
        board.corners_mm.copy(),
        np.zeros((len(priors.discs_px), 2)),
    )
    return AdjustmentProblem(board, terms, views, state, priors, main_views), state


def _adjusted(
    problem: AdjustmentProblem,
    state: AdjustmentState,
    spreads: PrintSpread,
    system: NormalEquations,
) -> AdjustmentResult:
    """Put the result together; the system is that of this state."""
    return AdjustmentResult(
        state.lens,
        state.shape[:SHAPE_PARAMETERS],
        state.poses,
        state.rig,
        state.corners_mm,
        state.discs_px,
        problem.posterior(system),
        spreads,
        system.scale,
        tuple(system.view_rms),
        tuple(system.view_kept),
        system.main_rms,
    )


def _renewed(
    spreads: PrintSpread,
    problem: AdjustmentProblem,
    state: AdjustmentState,
    system: NormalEquations,
    columns: int,
) -> PrintSpread:
    """Estimate the spreads again from the fitted lines and corners (MacKay 1992).

    sum of squares = gamma sigma^2, with gamma the number of well-determined ones:
    n - trace(posterior covariance) / sigma^2.
    """
    variance = problem.line_variance(system)
    lines = state.shape[SHAPE_PARAMETERS:]
    corner = spreads.corner_mm
    if corner > 0.0:
        own = np.trace(np.linalg.inv(system.corner), axis1=1, axis2=2) * system.scale**2
        freedom = 2.0 * len(own) - float(own.sum()) / corner**2
        squares = float((state.offsets_mm**2).sum())
        corner = max(float(np.sqrt(squares / max(freedom, 1.0))), _LEAST_CORNER_MM)
    return replace(
        spreads,
        column_mm=_line_spread(spreads.column_mm, lines[:columns], variance[:columns]),
        row_mm=_line_spread(spreads.row_mm, lines[columns:], variance[columns:]),
        corner_mm=corner,
    )


def _line_spread(sigma_mm: float, lines_mm: FloatArray, variance_mm2: FloatArray) -> float:
    if sigma_mm == 0.0:
        return 0.0
    freedom = len(lines_mm) - float(variance_mm2.sum()) / sigma_mm**2
    squares = float((lines_mm**2).sum()) + _PRIOR_LINES * _PRIOR_LINE_MM**2
    renewed = float(np.sqrt(squares / (max(freedom, 0.0) + _PRIOR_LINES)))
    return max(renewed, _LEAST_LINE_MM)


__all__ = ["AdjustmentPriors", "AdjustmentResult", "PrintSpread", "adjust", "predict_adjustment"]
