"""A lens to start from, when nothing is known of it and some of the views may be wrong.

Pinhole and fisheye lenses of many focal lengths are tried on each view; the one with the least
median residual over the views is taken (least median of squares, Rousseeuw 1984), fitted to the
views that agree best, and the others are let in as far as they fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.resection import MIN_CORNERS, BoardView, pose_from_rays, resect
from core.errors import CalibrationError, TargetNotFoundError
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens.lens_fit import as_model, fit_lens, wide_prior
from core.lens_model import LensModel

MIN_VIEWS = 3
"""Zhang's method needs three views of a plane for all five intrinsics."""
_CORNERS_A_VIEW, _CORNERS_A_TRIAL = 100, 40
"""Corners of a view that are fitted, and that each of some twenty lenses is tried on."""
_SIGMA_PX = 0.05
"""1 sigma of every corner: a corner before its fit, or of another program."""
_AGREE = 0.6
"""Share of the views that the lens is first fitted to; so many must be right."""
_WORSE = 5.0
"""A view fits that is off by no more than so many times what most are."""
_FLOOR_PX = 0.5
"""And any view that is off by no more than this."""
_ROUNDS = 6
"""Of choosing views and fitting to them; two or three settle."""
_NO_FIT_PX = 1e6
"""For a view that no pose fits: larger than any image."""
_TANGENT_HANDICAP = 0.9
"""A fisheye must be better by this factor to be preferred: it also fits a lens without
distortion."""
_PRIOR_FACTOR = 3.0
"""The priors of the lens are so many times wider here, so that the views decide."""
_MOST_WRONG = 0.5
"""Share of the corners that must miss for a view to be called another thing than the board."""
_TANGENT_FOCAL = np.geomspace(0.3, 8.0, 12)
"""Focal lengths tried, in image widths: fields of view of 118 to 7 degrees, a third apart."""
_FISHEYE_FOCAL = np.geomspace(0.15, 1.2, 8)
"""Likewise of a fisheye: 380 to 48 degrees."""

ImageSize = tuple[int, int]
"""Width and height, px."""


@dataclass(frozen=True, slots=True)
class StartLens:
    """A lens good enough to start an adjustment from."""

    lens: Lens
    rejected: tuple[tuple[int, str], ...]
    """Views that do not belong to the others, with the reason."""


def start_lens(
    views: Sequence[BoardView],
    board: Board,
    size: ImageSize,
    focal_px: float | None = None,
    model: LensModel | None = None,
) -> StartLens:
    """Find a lens and the views that agree on it, a third or more of which may be wrong.

    focal_px is the nominal focal length where one is known, model the lens's, likewise. Raises
    CalibrationError if fewer than three views agree.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationError(_too_few(len(views), len(views)))
    thin = [subsample(view, _CORNERS_A_VIEW) for view in views]
    few = [subsample(view, _CORNERS_A_TRIAL) for view in thin]
    kinds = []
    for trials in _trials(size, focal_px, model):
        tried = [_try_lens(lens, board, few) for lens in trials]
        first = min(tried, key=lambda t: float(np.median(t.off_px)))
        if np.median(first.off_px) < _NO_FIT_PX:
            kinds.append(_fit_consensus(first, board, thin))
    kinds = [kind for kind in kinds if len(kind.kept) >= MIN_VIEWS]
    if not kinds:
        raise CalibrationError(_too_few(len(views), 0))
    limit_px = max(_FLOOR_PX, _WORSE * min(kind.typical_px for kind in kinds))
    best = min(kinds, key=lambda kind: kind.cost(limit_px))
    lens = best.lens if model is None else as_model(best.lens, model)
    return StartLens(lens, _reasons(best, board, thin))


def _too_few(given: int, fit: int) -> str:
    return (
        f"lens: {given} views of the board given, {fit} fit together and {MIN_VIEWS} are needed; "
        "take new ones, the board still and sharp, tilted to 25 degrees"
    )


def _trials(size: ImageSize, focal_px: float | None, wanted: LensModel | None) -> list[list[Lens]]:
    """Lenses to try: tangent lenses, then fisheyes, or only those of the kind wanted."""
    width, height = size
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    known = None if focal_px is None else [focal_px]
    return [
        [Lens.ideal(model, focal, centre) for focal in known or width * grid]
        for model, grid in (
            (LensModel.RADIAL, _TANGENT_FOCAL),
            (LensModel.FISHEYE, _FISHEYE_FOCAL),
        )
        if wanted is None or (wanted is LensModel.FISHEYE) == (model is LensModel.FISHEYE)
    ]


def subsample(view: BoardView, corners: int) -> BoardView:
    """About so many corners of a view, spread over it, all trusted alike."""
    count = len(view.index)
    keep = np.unique(np.linspace(0, count - 1, min(count, corners)).astype(int))
    even = np.broadcast_to(_SIGMA_PX**2 * np.eye(2), (len(keep), 2, 2))
    return BoardView(view.index[keep], view.points_px[keep], even)


@dataclass(frozen=True, slots=True)
class _LensTrial:
    """All views as a lens sees them."""

    lens: Lens
    poses: tuple[Pose | None, ...]
    off_px: FloatArray
    """(views,) how far the corners of each are off, rms: one wrong corner counts."""
    median_px: FloatArray
    """(views,) how far half of them are off at most."""


def _try_lens(lens: Lens, board: Board, views: Sequence[BoardView]) -> _LensTrial:
    """Each view's median residual under a lens without distortion, by a pose without refinement."""
    rays = lens.rays(np.concatenate([view.points_px for view in views]))
    ends = np.cumsum([len(view.index) for view in views])[:-1]
    poses: list[Pose | None] = []
    off = np.full(len(views), _NO_FIT_PX)
    for v, (view, own) in enumerate(zip(views, np.split(rays, ends), strict=True)):
        points = board.corners_mm[view.index]
        try:
            pose = pose_from_rays(own, points) if len(points) >= MIN_CORNERS else None
        except TargetNotFoundError:
            pose = None
        poses.append(pose)
        if pose is None:
            continue
        miss = np.hypot(*(view.points_px - lens.project(pose.apply(points))).T)
        off[v] = np.median(miss) if np.isfinite(miss).all() else _NO_FIT_PX
    return _LensTrial(lens, tuple(poses), off, off)


def _pose(
    lens: Lens, board: Board, view: BoardView, start: Pose | None = None
) -> tuple[Pose | None, FloatArray]:
    """Pose of a view, and how far each corner is off, px."""
    try:
        found = resect(lens, board.corners_mm, view, start)
        if start is not None and not found.median_rms_px < _FLOOR_PX:  # perhaps a false minimum
            again = resect(lens, board.corners_mm, view)
            found = min(found, again, key=lambda each: each.median_rms_px)
    except TargetNotFoundError:
        return None, np.full(max(len(view.index), 1), _NO_FIT_PX)
    off = np.hypot(*found.residuals_px.T)
    if not np.isfinite(off).all():
        return None, np.full(max(len(view.index), 1), _NO_FIT_PX)
    return found.pose, off


def _refit_poses(
    lens: Lens, board: Board, views: Sequence[BoardView], before: _LensTrial
) -> _LensTrial:
    """Each view's residual, its pose fitted."""
    fits = [_pose(lens, board, v, pose) for v, pose in zip(views, before.poses, strict=True)]
    rms = np.array([float(np.sqrt((off**2).mean())) for _, off in fits])
    half = np.array([float(np.median(off)) for _, off in fits])
    return _LensTrial(lens, tuple(pose for pose, _ in fits), rms, half)


@dataclass(frozen=True, slots=True)
class _Consensus:
    """A lens and the views that agree on it."""

    seen: _LensTrial
    kept: tuple[int, ...]
    typical_px: float

    @property
    def lens(self) -> Lens:
        return self.seen.lens

    def cost(self, limit_px: float) -> tuple[int, float]:
        """The kind that more views fit is the right one; of equals the tangent, if as good."""
        handicap = 1.0 if self.lens.model is LensModel.FISHEYE else _TANGENT_HANDICAP
        return -int((self.seen.off_px <= limit_px).sum()), handicap * self.typical_px


def _fit_consensus(seen: _LensTrial, board: Board, views: Sequence[BoardView]) -> _Consensus:
    """Fit to the views that fit best, again and again, then let in all that fit as well.

    Views near the image's edge fit a lens badly that others were fitted to: they are let in when
    most of their corners fit, and judged by all their corners only after that.
    """
    enough = max(MIN_VIEWS, int(np.ceil(_AGREE * len(views))))
    kept: tuple[int, ...] = ()
    for _ in range(_ROUNDS):
        chosen = tuple(sorted(np.argsort(seen.off_px, kind="stable")[:enough].tolist()))
        if chosen == kept:
            break
        kept = chosen
        seen = _fitted(seen, kept, board, views)
    for by_most in (True, False):
        for _ in range(_ROUNDS):
            chosen = _as_good(seen.median_px if by_most else seen.off_px, enough)
            if chosen == kept or len(chosen) < MIN_VIEWS:
                break
            kept = chosen
            seen = _fitted(seen, kept, board, views)
    return _Consensus(seen, kept, float(np.median(np.sort(seen.off_px)[:enough])))


def _as_good(off_px: FloatArray, enough: int) -> tuple[int, ...]:
    """Views that are off by no more than a few times the best ones."""
    typical = float(np.median(np.sort(off_px)[:enough]))
    return tuple(np.nonzero(off_px <= max(_FLOOR_PX, _WORSE * typical))[0].tolist())


def _fitted(
    seen: _LensTrial, kept: Sequence[int], board: Board, views: Sequence[BoardView]
) -> _LensTrial:
    """All views by the lens fitted to some; the lens as it was if they determine too little."""
    good = [(views[v], pose) for v in kept if (pose := seen.poses[v]) is not None]
    lens = seen.lens
    models = [lens.model, LensModel.BROWN] if lens.model is LensModel.RADIAL else [lens.model]
    poses = [pose for _, pose in good]
    for model in models:
        start = as_model(lens, model)
        try:
            fitted = fit_lens(
                start,
                board.corners_mm,
                [v for v, _ in good],
                poses,
                _PRIOR_FACTOR * wide_prior(start),
            )
        except np.linalg.LinAlgError:
            break
        lens, poses = fitted.lens, list(fitted.poses)
    return _refit_poses(lens, board, views, seen)


def _reasons(
    agreed: _Consensus, board: Board, views: Sequence[BoardView]
) -> tuple[tuple[int, str], ...]:
    """Why views are left out: they do not fit, or are mirror images of the others."""
    found = [
        _pose(agreed.lens, board, view, pose)
        for view, pose in zip(views, agreed.seen.poses, strict=True)
    ]
    rejected = {
        v: _residual_text(view, off, pose, agreed.typical_px)
        for v, (view, (pose, off)) in enumerate(zip(views, found, strict=True))
        if v not in agreed.kept
    }
    front = {v: _from_the_front(p) for v in agreed.kept if (p := found[v][0]) is not None}
    usual = 2 * sum(front.values()) >= len(front)
    for v, is_front in front.items():
        if is_front != usual:
            rejected[v] = (
                "mirrored: its corners run the other way round than those of the other views"
            )
    return tuple(sorted(rejected.items()))


def _from_the_front(pose: Pose) -> bool:
    """Whether the board's z axis points away from the camera, as it must."""
    return float(pose.R[:, 2] @ pose.t_mm) > 0.0


def _residual_text(view: BoardView, off: FloatArray, pose: Pose | None, typical_px: float) -> str:
    if len(view.index) < MIN_CORNERS:
        return f"{len(view.index)} corners of the board, {MIN_CORNERS} are needed"
    if pose is None:
        return f"its {len(view.index)} corners fit no view of the board"
    wrong = int((off > max(1.0, _WORSE * typical_px)).sum())
    rms = float(np.sqrt((off**2).mean()))
    amount = f"corners off by {rms:.2f} px rms, those of the other views by {typical_px:.2f} px"
    if wrong < _MOST_WRONG * len(off):
        return (
            f"does not fit the other views: {wrong} of its {len(off)} corners are not where the "
            f"board has them, up to {off.max():.1f} px away"
        )
    return f"does not fit the other views: {amount}; its corners are not the board's or misnamed"
