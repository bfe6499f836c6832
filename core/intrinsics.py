"""The sub-camera's lens from views of the board (Eq. 10; Zhang's planar method)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from core.adjustment import Adjusted, AdjustmentPriors, adjust
from core.board import Board
from core.corners import detect_board, locate_board
from core.errors import CalibrationError, TargetNotFoundError
from core.frames import GreyImage
from core.lens import Lens, LensModel
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
    """Which of the images were used, in the order of `adjusted.poses`."""
    rejected: tuple[tuple[int, str], ...]
    """Which were not, and why."""


def calibrate_lens(
    images: Sequence[GreyImage], board: Board, camera: CameraGeometry, *, skew: bool = False
) -> LensCalibration:
    """Calibrate a lens from images of a board, the board's own shape estimated with it.

    Views without the board, or that do not fit the others, are rejected with their reason.
    Raises CalibrationError.
    """
    found: list[tuple[int, BoardView]] = []
    rejected: list[tuple[int, str]] = []
    for k, image in enumerate(images):
        try:
            found.append((k, detect_board(image, board).view))
        except TargetNotFoundError as error:
            rejected.append((k, str(error)))
    start = start_lens([view for _, view in found], board, camera)
    misfits = set(start.rejected)
    rejected += [(found[v][0], "does not fit the other views") for v in sorted(misfits)]
    used, views, poses = [], [], []
    for v, (k, view) in enumerate(found):
        if v not in misfits:
            pose = resect(start.lens, board.corners_mm, view).pose
            located = locate_board(images[k], start.lens, board, board.corners_mm, pose)
            used.append(k)
            views.append(located.view)
            poses.append(pose)
    priors = AdjustmentPriors(lens=lens_prior(camera, skew=skew))
    adjusted = adjust(board, views, start.lens, poses, priors)
    return LensCalibration(adjusted.lens, adjusted, tuple(used), tuple(sorted(rejected)))
