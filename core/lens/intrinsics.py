"""The sub-camera's lens from views of the board (Eq. 10; Zhang's planar method)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.adjustment.bundle_adjustment import AdjustmentPriors, AdjustmentResult, adjust
from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.corners import LocatedBoard, detect_board, refine_board
from core.checkerboard.resection import BoardView, resect
from core.errors import CalibrationError, TargetNotFoundError
from core.geometry.lens import Lens
from core.images import GreyImage, light_fault
from core.lens.lens_choice import LensChoice, choose_lens
from core.lens.lens_fit import wide_prior
from core.lens.lens_start import ImageSize, start_lens
from core.lens.mirrored import MIRRORED, looks_mirrored
from core.lens_model import LensModel
from core.site import CameraGeometry

_LEAST_LOCATED, _MOST_OFF_PX = 0.9, 0.5
"""A view that did not fit by its first corners is let in where this share of its corners is located
with the lens known, and they are off by no more. Chosen: a board that is not this one misses
both."""
_FOCAL_SIGMA, _CENTRE_SIGMA = 0.05, 0.05
"""1-sigma priors about a lens as drawn: focal length, relative (makers: a few per cent), and
principal point, in image widths."""
_CORNER_SIGMA_PX = 0.05
"""1 sigma of corners of another program, unless given: OpenCV's finder on sharp images."""
_BOW_SHARES = (4e-3, 1.2e-3, 1.2e-3)
"""1-sigma priors of the bow of paper on a stiff back, by degree (2, 3, 4), of half the board's
size."""
_CORNER_SHARE = 5e-3
"""Where the estimate of the corners' own print errors starts, of a square's side."""
_SQUARE = 1e-3
"""Sensors' pixels are square to better than this, 1 sigma."""


def lens_prior(
    camera: CameraGeometry, *, skew: bool = False, model: LensModel = LensModel.BROWN
) -> FloatArray:
    """(lens parameters,) 1-sigma about their start, wide for all but the skew."""
    focal, centre = _FOCAL_SIGMA * camera.focal_px, _CENTRE_SIGMA * camera.width_px
    sigmas = wide_prior(Lens.ideal(model, camera.focal_px, camera.centre_px), skew=skew)
    sigmas[[0, 1, 3, 4]] = focal, focal, centre, centre
    return sigmas


def nominal_lens(camera: CameraGeometry) -> Lens:
    """Give the lens as drawn: no distortion, the principal point in the middle."""
    return Lens.ideal(LensModel.BROWN, camera.focal_px, camera.centre_px)


@dataclass(frozen=True, slots=True)
class LensCalibration:
    """A lens calibrated from views of a board."""

    lens: Lens
    adjustment: AdjustmentResult
    used: tuple[int, ...]
    """Which of the views were used, in the order of `adjustment.poses`."""
    rejected: tuple[tuple[int, str], ...]
    """Which were not, and why."""
    choice: LensChoice
    """How the distortion's model was chosen."""
    quarter_turns: tuple[int, ...] = ()
    """By how many quarter turns each view used shows the board turned, where that is known."""


def calibrate_lens(
    images: Sequence[GreyImage],
    board: Board,
    camera: CameraGeometry | None = None,
    *,
    model: LensModel | None = None,
    skew: bool = False,
) -> LensCalibration:
    """Calibrate a lens from images of a board, the board's own shape estimated with it.

    Nothing need be known of the lens; it may be a fisheye. Without a model the one that predicts
    held-out views best is taken (core.lens.lens_choice). Views without the board, or that do not
    fit the others, are rejected with their reason. Raises CalibrationError.
    Source: Eq. 10 of Lee et al. (2020), Zhang (2000), with distortion and the board's shape; an
    example with images is in docs/functions.md.
    """
    found: list[tuple[int, LocatedBoard]] = []
    rejected: list[tuple[int, str]] = []
    for k, image in enumerate(images):
        try:
            found.append((k, detect_board(image, board)))
        except TargetNotFoundError as error:
            rejected.append((k, light_fault(image) or str(error)))
    if not found:
        first = f"; view {rejected[0][0]}: {rejected[0][1]}" if rejected else ""
        msg = f"lens: none of {len(images)} images shows the board{first}"
        raise CalibrationError(msg)
    height, width = images[found[0][0]].pixels.shape
    focal_px = None if camera is None else camera.focal_px
    views_px = [seen.view for _, seen in found]
    start = start_lens(views_px, board, (width, height), focal_px, model)
    residual_ratios = dict(start.rejected)
    used, views, turns = [], [], []
    for v, (k, seen) in enumerate(found):
        given = seen.view, start.lens, board, board.corners_mm, (width, height)
        if v in residual_ratios and looks_mirrored(*given):
            rejected.append((k, MIRRORED))
            continue
        try:
            located = _refined(images[k], start.lens, board, seen.view)
            if v in residual_ratios:
                _require_fit(located, start.lens, board)
        except TargetNotFoundError as error:
            rejected.append((k, residual_ratios.get(v, str(error))))
            continue
        used.append(k)
        views.append(located.view)
        turns.append(seen.quarter_turns)
    adjusted, choice = _adjusted(views, board, start.lens, model, skew=skew)
    return LensCalibration(
        adjusted.lens,
        adjusted,
        tuple(used),
        tuple(sorted(rejected)),
        choice,
        tuple(turns),
    )


def _refined(image: GreyImage, lens: Lens, board: Board, view: BoardView) -> LocatedBoard:
    """Locate all corners with the lens known, from those that were found without it."""
    pose = resect(lens, board.corners_mm, view).pose
    return refine_board(image, lens, pose, board, board.corners_mm)


def _require_fit(located: LocatedBoard, lens: Lens, board: Board) -> None:
    """Let a view in after all if only a wrong corner among those first found made it not fit.

    Raises TargetNotFoundError.
    """
    off_px = resect(lens, board.corners_mm, located.view).median_rms_px
    if len(located.view.index) < _LEAST_LOCATED * located.visible or off_px > _MOST_OFF_PX:
        msg = f"{len(located.view.index)} of {located.visible} corners, off by {off_px:.2f} px rms"
        raise TargetNotFoundError(msg)


def calibrate_lens_from_corners(
    corners_px: Sequence[FloatArray | None],
    board: Board,
    size: ImageSize,
    *,
    sigma_px: float = _CORNER_SIGMA_PX,
    model: LensModel | None = None,
    skew: bool = False,
) -> LensCalibration:
    """Calibrate a lens from corners found by any other program, e.g. OpenCV's finder.

    corners_px holds one array a view, (rows * columns, 2) or (rows * columns, 1, 2), row by row
    as in `Board`; NaN where a corner was not found, None for a view without any. size is the
    image's width and height, px. Views whose corners are not the board's (a row shifted,
    mirrored, on other things) are rejected with their reason. Raises CalibrationError.
    Source: Zhang (2000), with the board's shape (core.adjustment.bundle_adjustment).

    >>> from core import Pose
    >>> board = Board.of_squares(10, 7, 30.0)
    >>> lens = Lens.ideal(LensModel.RADIAL, 600.0, (310.0, 250.0))
    >>> turns = np.array([[0.4, 0, 0], [-0.4, 0, 0.1], [0, 0.4, 0], [0, -0.4, 0.2], [0.3, 0.3, 0]])
    >>> poses = [Pose.from_vectors(turn, np.array([-140.0, -90.0, 500.0])) for turn in turns]
    >>> corners_px = [lens.project(pose.apply(board.corners_mm)) for pose in poses]
    >>> found = calibrate_lens_from_corners(corners_px, board, (640, 480), model=LensModel.RADIAL)
    >>> found.lens.parameters[[0, 1, 3, 4]].round(1).tolist(), found.used
    ([600.0, 600.0, 310.0, 250.0], (0, 1, 2, 3, 4))
    """
    views = [_view_of_corners(corners, k, board, sigma_px) for k, corners in enumerate(corners_px)]
    start = start_lens(views, board, size, model=model)
    residual_ratios = dict(start.rejected)
    used = tuple(k for k in range(len(views)) if k not in residual_ratios)
    adjusted, choice = _adjusted([views[k] for k in used], board, start.lens, model, skew=skew)
    return LensCalibration(adjusted.lens, adjusted, used, start.rejected, choice)


def _view_of_corners(
    corners_px: FloatArray | None, k: int, board: Board, sigma_px: float
) -> BoardView:
    count = board.columns * board.rows
    given = np.full((count, 2), np.nan) if corners_px is None else np.asarray(corners_px, float)
    if given.size != 2 * count:
        msg = (
            f"lens: view {k} has corners of shape {given.shape}, the board has "
            f"{board.columns}x{board.rows}; give all, NaN where one was not found"
        )
        raise CalibrationError(msg)
    points = given.reshape(count, 2)
    index = np.nonzero(np.isfinite(points).all(axis=1))[0]
    covariance = np.tile(sigma_px**2 * np.eye(2), (len(index), 1, 1))
    return BoardView(index, points[index], covariance)


def _adjusted(
    views: Sequence[BoardView],
    board: Board,
    start: Lens,
    model: LensModel | None,
    *,
    skew: bool,
) -> tuple[AdjustmentResult, LensChoice]:
    """Lens, poses and board together, again if another model than the start's is chosen."""

    def fit(lens: Lens) -> tuple[AdjustmentResult, LensChoice]:
        adjusted = _adjust_jointly(views, board, lens, skew=skew)
        given = adjusted.lens, adjusted.corners_mm, views, adjusted.poses, model
        return adjusted, choose_lens(*given)

    adjusted, choice = fit(start)
    if choice.lens.model is adjusted.lens.model:
        return adjusted, choice
    adjusted, again = fit(choice.lens)  # the board is another now, too
    return adjusted, again if again.lens.model is adjusted.lens.model else choice


def _adjust_jointly(
    views: Sequence[BoardView], board: Board, lens: Lens, *, skew: bool
) -> AdjustmentResult:
    """Paper boards are as uneven as they are large; sensors have square pixels."""
    half_mm = 0.5 * float(np.ptp(board.corners_mm, axis=0).max())
    second, third, fourth = _BOW_SHARES
    priors = AdjustmentPriors(
        lens=wide_prior(lens, skew=skew),
        square=_SQUARE,
        bow_mm=(second * half_mm, third * half_mm, fourth * half_mm),
        corner_mm=_CORNER_SHARE * board.square_mm,
    )
    poses = [resect(lens, board.corners_mm, view).pose for view in views]
    return adjust(board, views, lens, poses, priors)
