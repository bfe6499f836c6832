"""Which distortion model a lens is given: the simplest of those that predict unseen views best.

A model with more coefficients always fits the views better that it is fitted to. So each model is
fitted to four fifths of the views and judged on the others (cross-validation; Stone 1974): the
pose of such a view is fitted to every other corner, and the error taken at the rest. Of models
that differ by less than the noise of the comparison, two standard errors, the one with the fewest
coefficients is taken (after Breiman et al., "Classification and regression trees" (1984); with
one standard error a needless coefficient was let in by chance in some sets of 15 views).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.resection import BoardView, resect
from core.errors import TargetNotFoundError
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens.lens_fit import FittedLens, as_model, fit_lens, wide_prior
from core.lens.lens_start import subsample
from core.lens_model import LensModel

MIN_VIEWS = 6
"""With fewer, what is held out says nothing."""
_FOLDS = 5
"""Of the cross-validation: each model is fitted to four fifths of the views (five is customary)."""
_CORNERS_A_VIEW = 120
"""Spread over the view: enough to show distortion, and quick."""
_OUTLIER_FACTOR = 6.0
"""Squared errors count at most this factor, squared, times the median's."""
_STANDARD_ERRORS = 2.0
"""By which a model must be worse than the best one to be given up for it, see above."""
_PRIOR_FACTOR = 3.0
"""The priors of the lens are so many times wider here, so that the views decide."""
_WIDE_RAD, _WIDEST_TANGENT_RAD = 0.7, 1.3
"""Seen further off the axis a lens may be a fisheye; further than the second it is one."""
_TANGENT = (LensModel.RADIAL, LensModel.BROWN, LensModel.RATIONAL)


@dataclass(frozen=True, slots=True)
class LensChoice:
    """The model chosen, and what speaks for it."""

    lens: Lens
    """Of that model, fitted to all views; good to start from."""
    held_out_px: dict[LensModel, float]
    """Rms error of a coordinate at corners held out, of each model compared; may be empty."""
    why: str = ""
    """Why nothing was compared, if so."""

    @property
    def sentence(self) -> str:
        """One line for a report."""
        model = f"distortion: {self.lens.model}"
        if not self.held_out_px:
            return f"{model}, {self.why}"
        errors = ", ".join(f"{model} {px:.4f}" for model, px in self.held_out_px.items())
        return f"{model}, chosen on held-out views ({errors} px)"


def choose_lens(
    lens: Lens,
    corners_mm: FloatArray,
    views: Sequence[BoardView],
    poses: Sequence[Pose],
    wanted: LensModel | None = None,
) -> LensChoice:
    """Choose among the models that may be, starting from a lens of one of them.

    corners_mm (m, 3) is the board as estimated, poses[v] that of views[v] by the lens.
    """
    if wanted is not None:
        return LensChoice(lens, {}, "as configured")
    if len(views) < MIN_VIEWS:
        return LensChoice(lens, {}, f"not compared with others on only {len(views)} views")
    thin = [subsample(view, _CORNERS_A_VIEW) for view in views]
    models = _models(lens, thin)
    starts = [_fit(as_model(lens, model), corners_mm, thin, poses) for model in models]
    fits = [fit for fit in starts if fit is not None]
    fits.sort(key=lambda fit: fit.lens.size)
    errors = {fit.lens.model: _held_out(fit, corners_mm, thin) for fit in fits}
    errors = {model: squares for model, squares in errors.items() if np.isfinite(squares).all()}
    if not errors:
        return LensChoice(lens, {}, "no other could be fitted")
    per_view = _without_outliers(errors)
    chosen = _simplest(per_view)
    best = next(fit.lens for fit in fits if fit.lens.model is chosen)
    return LensChoice(best, {m: float(np.sqrt(each.mean())) for m, each in per_view.items()})


def _models(lens: Lens, views: Sequence[BoardView]) -> list[LensModel]:
    """What a lens may be that sees so far off its axis."""
    rays = lens.rays(np.concatenate([view.points_px for view in views]))
    widest = float(np.arccos(rays[:, 2].min()))
    fisheye = lens.model is LensModel.FISHEYE
    tangent = not fisheye or widest < _WIDEST_TANGENT_RAD
    models = list(_TANGENT) if tangent else []
    return [*models, LensModel.FISHEYE] if fisheye or widest > _WIDE_RAD else models


def _fit(
    start: Lens, corners_mm: FloatArray, views: Sequence[BoardView], poses: Sequence[Pose]
) -> FittedLens | None:
    try:
        return fit_lens(start, corners_mm, views, poses, _PRIOR_FACTOR * wide_prior(start))
    except np.linalg.LinAlgError:
        return None


def _held_out(whole: FittedLens, corners_mm: FloatArray, views: Sequence[BoardView]) -> FloatArray:
    """(views, corners) squared error of a coordinate, px^2, each view by a fit to others.

    NaN fills up views of fewer corners; infinity says that a fit failed.
    """
    squares = np.full((len(views), max((len(v.index) + 1) // 2 for v in views)), np.nan)
    for fold in range(_FOLDS):
        kept = [v for v in range(len(views)) if v % _FOLDS != fold]
        fit = _fit(whole.lens, corners_mm, [views[v] for v in kept], [whole.poses[v] for v in kept])
        if fit is None:
            return np.full((len(views), 1), np.inf)
        for v in range(fold, len(views), _FOLDS):
            error = _squared_errors(fit.lens, corners_mm, views[v], whole.poses[v])
            squares[v, : len(error)] = error
    return squares


def _squared_errors(lens: Lens, corners_mm: FloatArray, view: BoardView, near: Pose) -> FloatArray:
    """(n / 2,) squared error of a coordinate at every other corner, the pose by the rest."""
    odd = np.arange(len(view.index)) % 2 == 1
    half = view.select(~odd)
    try:
        pose = resect(lens, corners_mm, view.select(odd), near).pose
    except TargetNotFoundError:
        return np.full(len(half.index), np.inf)
    miss = half.points_px - lens.project(pose.apply(corners_mm[half.index]))
    return np.asarray((miss**2).sum(axis=1) / 2.0)


def _without_outliers(errors: dict[LensModel, FloatArray]) -> dict[LensModel, FloatArray]:
    """(views,) mean square of each view: wrong corners count no more than a few times others."""
    most = _OUTLIER_FACTOR**2 * min(float(np.nanmedian(squares)) for squares in errors.values())
    return {m: np.nanmean(np.minimum(squares, most), axis=1) for m, squares in errors.items()}


def _simplest(per_view: dict[LensModel, FloatArray]) -> LensModel:
    """The first, they are in order of size, that is not worse than the best beyond the noise."""
    best = min(per_view.values(), key=lambda squares: float(squares.mean()))
    for model, squares in per_view.items():
        worse = squares - best
        noise = float(worse.std(ddof=1)) / np.sqrt(len(worse))
        if float(worse.mean()) <= _STANDARD_ERRORS * noise:
            return model
    raise AssertionError  # the best is one of them
