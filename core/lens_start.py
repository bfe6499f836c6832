"""A lens to start from, when nothing is known of it and some of the views may be wrong.

Pinhole and fisheye lenses of many focal lengths are tried on each view; the one with the least
median misfit over the views is taken (least median of squares, Rousseeuw 1984), fitted to the
views that agree best, and the others are let in as far as they fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.adjustment import AdjustmentPriors, adjust
from core.board import Board
from core.errors import CalibrationError, TargetNotFoundError
from core.lens import Lens, LensModel
from core.pose import Pose
from core.resection import BoardView, resect
from core.site import FloatArray

MIN_VIEWS = 3
_CORNERS_A_VIEW = 100
_AGREE = 0.6
"""Share of the views that the lens is first fitted to; so many must be right."""
_WORSE = 5.0
_FLOOR_PX = 0.5
_ROUNDS = 6
_NO_FIT_PX = 1e6
_CLEARLY = 0.9
_TANGENT_FOCAL = np.geomspace(0.3, 8.0, 12)
_FISHEYE_FOCAL = np.geomspace(0.15, 1.2, 8)
"""Focal lengths tried, in image widths."""

ImageSize = tuple[int, int]
"""Width and height, px."""


@dataclass(frozen=True, slots=True)
class StartLens:
    """A lens good enough to start an adjustment from."""

    lens: Lens
    rejected: tuple[tuple[int, str], ...]
    """Views that do not belong to the others, with the reason."""


def wide_prior(lens: Lens, *, skew: bool = False) -> FloatArray:
    """(size,) 1-sigma of the lens parameters about a start: wide for all but the skew."""
    focal = 0.1 * lens.parameters[0]
    gamma = 0.005 * lens.parameters[0] if skew else 0.0
    radial = 0.1 if lens.model is LensModel.FISHEYE else 0.3
    sigmas = {"p1": 0.02, "p2": 0.02}
    distortion = [sigmas.get(name, radial) for name in lens.model.coefficients]
    return np.array([focal, focal, gamma, focal, focal, *distortion])


def start_lens(
    views: Sequence[BoardView], board: Board, size: ImageSize, focal_px: float | None = None
) -> StartLens:
    """Find a lens and the views that agree on it, a third or more of which may be wrong.

    focal_px is the nominal focal length where one is known. Raises CalibrationError if fewer
    than three views agree.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationError(_too_few(len(views), len(views)))
    thin = [_thinned(view) for view in views]
    best: tuple[float, _Agreed] | None = None
    for trials in _trials(size, focal_px):
        misfits = [_misfits(lens, board, thin) for lens in trials]
        typical = [float(np.median(misfit)) for misfit in misfits]
        first = int(np.argmin(typical))
        if typical[first] >= _NO_FIT_PX:
            continue
        agreed = _agree(trials[first], misfits[first], board, thin)
        if best is None or agreed.typical_px < _CLEARLY * best[0]:
            best = agreed.typical_px, agreed
    if best is None or len(best[1].kept) < MIN_VIEWS:
        kept = 0 if best is None else len(best[1].kept)
        raise CalibrationError(_too_few(len(views), kept))
    return StartLens(best[1].lens, _reasons(best[1], board, thin))


def _too_few(given: int, fit: int) -> str:
    return (
        f"lens: {given} views of the board given, {fit} fit together and {MIN_VIEWS} are needed; "
        "take new ones, the board still and sharp, tilted to 25 degrees"
    )


def _trials(size: ImageSize, focal_px: float | None) -> list[list[Lens]]:
    """Lenses to try: tangent lenses, then fisheyes."""
    width, height = size
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    known = None if focal_px is None else [focal_px]
    return [
        [Lens.ideal(model, focal, centre) for focal in known or width * grid]
        for model, grid in (
            (LensModel.RADIAL, _TANGENT_FOCAL),
            (LensModel.FISHEYE, _FISHEYE_FOCAL),
        )
    ]


def _thinned(view: BoardView) -> BoardView:
    """Enough corners for a start, spread over the view."""
    step = max(1, len(view.index) // _CORNERS_A_VIEW)
    keep = np.zeros(len(view.index), dtype=bool)
    keep[::step] = True
    thin = view.select(keep)
    even = np.broadcast_to(0.05**2 * np.eye(2), (len(thin.index), 2, 2))
    return BoardView(thin.index, thin.points_px, even)


def _pose(lens: Lens, board: Board, view: BoardView) -> tuple[Pose | None, FloatArray]:
    """Pose of a view, and how far each corner is off, px."""
    try:
        found = resect(lens, board.corners_mm, view)
    except TargetNotFoundError:
        return None, np.full(len(view.index), _NO_FIT_PX)
    off = np.hypot(*found.residuals_px.T)
    if not np.isfinite(off).all():
        return None, np.full(len(view.index), _NO_FIT_PX)
    return found.pose, off


def _misfits(lens: Lens, board: Board, views: Sequence[BoardView]) -> FloatArray:
    """(views,) median distance of the corners from a fitted board, px."""
    return np.array([float(np.median(_pose(lens, board, view)[1])) for view in views])


@dataclass(frozen=True, slots=True)
class _Agreed:
    """A lens and the views that agree on it."""

    lens: Lens
    kept: tuple[int, ...]
    typical_px: float


def _agree(lens: Lens, misfits: FloatArray, board: Board, views: Sequence[BoardView]) -> _Agreed:
    """Fit to the views that fit best, again and again, then let in all that fit as well."""
    enough = max(MIN_VIEWS, int(np.ceil(_AGREE * len(views))))
    kept: tuple[int, ...] = ()
    for attempt in range(_ROUNDS):
        chosen = tuple(sorted(np.argsort(misfits, kind="stable")[:enough].tolist()))
        if chosen == kept:
            break
        kept = chosen
        lens = _fitted(lens, board, [views[v] for v in kept])
        if attempt == 0 and lens.model is LensModel.RADIAL:
            lens = extended(lens, LensModel.BROWN)
        misfits = _rms(lens, board, views)
    for _ in range(_ROUNDS):
        typical = float(np.median(np.sort(misfits)[:enough]))
        chosen = tuple(np.nonzero(misfits <= max(_FLOOR_PX, _WORSE * typical))[0].tolist())
        if chosen == kept or len(chosen) < MIN_VIEWS:
            break
        kept = chosen
        lens = _fitted(lens, board, [views[v] for v in kept])
        misfits = _rms(lens, board, views)
    return _Agreed(lens, kept, float(np.median(np.sort(misfits)[:enough])))


def _rms(lens: Lens, board: Board, views: Sequence[BoardView]) -> FloatArray:
    """(views,) rms distance of the corners from a fitted board, px: one wrong corner counts."""
    each = [_pose(lens, board, view)[1] for view in views]
    return np.array([float(np.sqrt((off**2).mean())) for off in each])


def _fitted(lens: Lens, board: Board, views: Sequence[BoardView]) -> Lens:
    """The lens fitted to views of the nominal board; as it was if they determine too little."""
    pairs = [(view, _pose(lens, board, view)[0]) for view in views]
    good = [(view, pose) for view, pose in pairs if pose is not None]
    priors = AdjustmentPriors(
        lens=3.0 * wide_prior(lens), scale=0.0, bow_mm=(0.0, 0.0, 0.0), corner_mm=0.0
    )
    try:
        adjusted = adjust(board, [v for v, _ in good], lens, [p for _, p in good], priors)
    except np.linalg.LinAlgError:
        return lens
    sound = np.isfinite(adjusted.lens.parameters).all() and adjusted.lens.parameters[:2].min() > 0
    return adjusted.lens if sound else lens


def extended(lens: Lens, model: LensModel) -> Lens:
    """The same lens with further coefficients of the same kind, all zero."""
    parameters = np.zeros(len(model.parameters))
    parameters[: lens.size] = lens.parameters
    return Lens(parameters, model)


def _reasons(
    agreed: _Agreed, board: Board, views: Sequence[BoardView]
) -> tuple[tuple[int, str], ...]:
    """Why views are left out: they do not fit, or are mirror images of the others."""
    found = [_pose(agreed.lens, board, view) for view in views]
    rejected = {
        v: _misfit_words(view, off, pose, agreed.typical_px)
        for v, (view, (pose, off)) in enumerate(zip(views, found, strict=True))
        if v not in agreed.kept
    }
    front = {v: _from_the_front(p) for v in agreed.kept if (p := found[v][0]) is not None}
    usual = sum(front.values()) >= 0.5 * len(front)
    for v, is_front in front.items():
        if is_front != usual:
            rejected[v] = (
                "mirrored: its corners run the other way round than those of the other views"
            )
    return tuple(sorted(rejected.items()))


def _from_the_front(pose: Pose) -> bool:
    """Whether the board's z axis points away from the camera, as it must."""
    return float(pose.R[:, 2] @ pose.t_mm) > 0.0


def _misfit_words(view: BoardView, off: FloatArray, pose: Pose | None, typical_px: float) -> str:
    if pose is None:
        return f"its {len(view.index)} corners fit no view of the board"
    wrong = int((off > max(1.0, _WORSE * typical_px)).sum())
    rms = float(np.sqrt((off**2).mean()))
    amount = f"corners off by {rms:.2f} px rms, those of the other views by {typical_px:.2f} px"
    if wrong < 0.5 * len(off):
        return (
            f"does not fit the other views: {wrong} of its {len(off)} corners are not where the "
            f"board has them, up to {off.max():.1f} px away"
        )
    return f"does not fit the other views: {amount}; its corners are not the board's or misnamed"
