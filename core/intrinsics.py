"""The sub-camera's lens from views of the board (Eq. 10; Zhang's planar method)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from core.adjustment import Adjusted, AdjustmentPriors, adjust
from core.board import Board
from core.corners import detect_board, refine_board
from core.errors import CalibrationError, TargetNotFoundError
from core.frames import GreyImage
from core.lens import Lens, LensModel
from core.lens_fit import wide_prior
from core.lens_start import ImageSize
from core.lens_start import start_lens as find_start
from core.pose import Pose
from core.resection import BoardView, resect
from core.site import CameraGeometry, FloatArray

_CORNERS_A_VIEW = 250
_MIN_VIEWS = 3


def lens_prior(camera: CameraGeometry, *, skew: bool = False) -> FloatArray:
    """(10,) 1-sigma of the lens parameters about their start, wide for all but the skew."""
    focal, centre = 0.05 * camera.focal_px, 0.05 * camera.width_px
    gamma = 0.005 * camera.focal_px if skew else 0.0
    return np.array([focal, focal, gamma, centre, centre, 0.3, 0.3, 0.02, 0.02, 0.3])


def nominal_lens(camera: CameraGeometry) -> Lens:
    """Give the lens as drawn: no distortion, the principal point in the middle."""
    return Lens.ideal(LensModel.BROWN, camera.focal_px, camera.centre_px)


@dataclass(frozen=True, slots=True)
class StartLens:
    """A lens good enough to start an adjustment from."""

    lens: Lens
    rejected: tuple[int, ...]
    """Views that do not fit the others."""


def start_lens(views: Sequence[BoardView], board: Board, camera: CameraGeometry) -> StartLens:
    """Zhang's method on views of the nominal board, from the nominal lens.

    The worst view is left out, one after another, as long as it fits more than five times worse
    than the median of the others and by more than half a pixel.
    Raises CalibrationError with fewer than three views left.
    """
    kept = list(range(len(views)))
    while len(kept) >= _MIN_VIEWS:
        lens, errors = _zhang([views[k] for k in kept], board, camera)
        worst = int(np.argmax(errors))
        others = float(np.median(np.delete(errors, worst)))
        if errors[worst] < max(0.5, 5.0 * others):
            rejected = tuple(sorted(set(range(len(views))) - set(kept)))
            return StartLens(lens, rejected)
        del kept[worst]
    msg = (
        f"lens: {len(views)} views of the board given, fewer than {_MIN_VIEWS} fit together; "
        "take new ones, the board still and sharp, tilted to 25 degrees"
    )
    raise CalibrationError(msg)


def _zhang(
    views: Sequence[BoardView], board: Board, camera: CameraGeometry
) -> tuple[Lens, FloatArray]:
    """OpenCV's implementation; also each view's rms error, px."""
    objects, images = [], []
    for view in views:
        some = slice(None, None, max(1, len(view.index) // _CORNERS_A_VIEW))
        objects.append(np.ascontiguousarray(board.corners_mm[view.index[some]], dtype=np.float32))
        images.append(np.ascontiguousarray(view.points_px[some], dtype=np.float32))
    size = (camera.width_px, camera.height_px)
    start = nominal_lens(camera).matrix
    _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
        objects, images, size, start, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    lens = Lens(
        np.array(
            [matrix[0, 0], matrix[1, 1], 0.0, matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]]
        )
    )
    errors = []
    for points, pixels, rotation, translation in zip(
        objects, images, rotations, translations, strict=True
    ):
        pose = Pose.from_vectors(np.ravel(rotation), np.ravel(translation))
        miss = lens.project(pose.apply(points.astype(float))) - pixels
        errors.append(float(np.sqrt((miss**2).sum(axis=1).mean())))
    return lens, np.array(errors)


@dataclass(frozen=True, slots=True)
class LensCalibration:
    """A lens calibrated from views of a board."""

    lens: Lens
    adjusted: Adjusted
    used: tuple[int, ...]
    """Which of the views were used, in the order of `adjusted.poses`."""
    rejected: tuple[tuple[int, str], ...]
    """Which were not, and why."""


def calibrate_lens(
    images: Sequence[GreyImage],
    board: Board,
    camera: CameraGeometry | None = None,
    *,
    skew: bool = False,
) -> LensCalibration:
    """Calibrate a lens from images of a board, the board's own shape estimated with it.

    Nothing need be known of the lens; it may be a fisheye. Views without the board, or that do
    not fit the others, are rejected with their reason. Raises CalibrationError.
    """
    found: list[tuple[int, BoardView]] = []
    rejected: list[tuple[int, str]] = []
    for k, image in enumerate(images):
        try:
            found.append((k, detect_board(image, board).view))
        except TargetNotFoundError as error:
            rejected.append((k, str(error)))
    if not found:
        msg = f"lens: none of {len(images)} images shows the board; {dict(rejected)}"
        raise CalibrationError(msg)
    height, width = images[found[0][0]].pixels.shape
    focal_px = None if camera is None else camera.focal_px
    start = find_start([view for _, view in found], board, (width, height), focal_px)
    misfits = dict(start.rejected)
    rejected += [(found[v][0], reason) for v, reason in misfits.items()]
    used = [k for v, (k, _) in enumerate(found) if v not in misfits]
    views = []
    for v, (k, view) in enumerate(found):
        if v not in misfits:
            pose = resect(start.lens, board.corners_mm, view).pose
            views.append(refine_board(images[k], start.lens, pose, board, board.corners_mm).view)
    return _adjusted(views, used, rejected, board, start.lens, skew=skew)


def calibrate_lens_from_corners(
    corners_px: Sequence[FloatArray],
    board: Board,
    size: ImageSize,
    *,
    sigma_px: float = 0.05,
    skew: bool = False,
) -> LensCalibration:
    """Calibrate a lens from corners found by any other program, e.g. OpenCV's finder.

    corners_px holds one array a view, (rows * columns, 2) or (rows * columns, 1, 2), row by row
    as in `Board`; NaN where a corner was not found. size is the image's width and height, px.
    Views whose corners are not the board's (a row shifted, mirrored, on other things) are
    rejected with their reason. Raises CalibrationError.
    """
    views = [
        _given(np.asarray(c, dtype=float), k, board, sigma_px) for k, c in enumerate(corners_px)
    ]
    start = find_start(views, board, size)
    misfits = dict(start.rejected)
    used = [k for k in range(len(views)) if k not in misfits]
    kept = [views[k] for k in used]
    return _adjusted(kept, used, list(start.rejected), board, start.lens, skew=skew)


def _given(corners_px: FloatArray, k: int, board: Board, sigma_px: float) -> BoardView:
    count = board.columns * board.rows
    if corners_px.size != 2 * count:
        msg = (
            f"lens: view {k} has corners of shape {corners_px.shape}, the board has "
            f"{board.columns}x{board.rows}; give all, NaN where one was not found"
        )
        raise CalibrationError(msg)
    points = corners_px.reshape(count, 2)
    index = np.nonzero(np.isfinite(points).all(axis=1))[0]
    covariance = np.tile(sigma_px**2 * np.eye(2), (len(index), 1, 1))
    return BoardView(index, points[index], covariance)


def _adjusted(
    views: Sequence[BoardView],
    used: Sequence[int],
    rejected: Sequence[tuple[int, str]],
    board: Board,
    start: Lens,
    *,
    skew: bool,
) -> LensCalibration:
    """Lens, poses and board together; paper boards are as uneven as they are large."""
    half_mm = 0.5 * float(np.ptp(board.corners_mm, axis=0).max())
    bow = (4e-3 * half_mm, 1.2e-3 * half_mm, 1.2e-3 * half_mm)
    priors = AdjustmentPriors(
        lens=wide_prior(start, skew=skew), bow_mm=bow, corner_mm=5e-3 * board.square_mm
    )
    poses = [resect(start, board.corners_mm, view).pose for view in views]
    adjusted = adjust(board, views, start, poses, priors)
    return LensCalibration(adjusted.lens, adjusted, tuple(used), tuple(sorted(rejected)))
