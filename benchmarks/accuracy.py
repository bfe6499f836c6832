"""How well one frame tells the pose and the discs: dcam, its Cramer-Rao bound, and plain OpenCV.

All on the same rendered frames, with the true lens and the true board given to everybody: this is
about locating, not about calibration. An error of a pose is the false displacement that it makes
at the main target.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.bound import disc_bound_mm, pose_bound_mm
from benchmarks.scene import IDEAL, REALISTIC, Scene, noisy
from core.arrays import FloatArray, IntArray
from core.checkerboard.corners import locate_board, predict_corners, refine_board
from core.checkerboard.resection import resect
from core.discs.disc_finder import find_discs
from core.geometry.pose import Pose
from core.images import GreyImage
from core.rig.compensation import affine
from core.site import Site

FRAMES = 24
SLOW_FRAMES = 8
"""Of those, for `findChessboardCornersSB`, which takes seconds."""
BOUND_FRAMES = 2
DISC_FRAMES = 24
_NARROW_PX, _USUAL_PX = 5, 11
"""Half windows of `cornerSubPix`."""
_MOVE_MM = 10.0

Estimator = Callable[[Scene, GreyImage, Pose], Pose]
"""From a frame and the pose expected (that of the rig at rest) to the pose."""


@dataclass(frozen=True, slots=True)
class Errors:
    """rms over the frames of the 2-vector of error at the main target, mm."""

    relative_mm: float
    """Of the motion from one frame to the next: each frame is the next one's reference."""
    frame_mm: float
    """Of each frame's own pose."""
    cpu_s: float
    """Median per frame, all of it."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """The same frames, seen by everybody."""

    name: str
    pose_bound_mm: float
    """Of one frame's own pose; a motion's is sqrt 2 of it."""
    ours: Errors
    claimed_mm: float
    """1 sigma of one frame's own pose as our fit gives it, rms of the 2-vector."""
    others: dict[str, Errors]
    disc_bound_mm: float
    discs: Errors
    other_discs: Errors
    fit_s: float
    """CPU time of our corner fit and pose, from a prediction; median."""
    subpix_s: dict[int, float]
    """CPU time of `cornerSubPix` and `solvePnP` on the same corners, same prediction, by window."""


def measure_accuracy(site: Site) -> tuple[Accuracy, ...]:
    """Measure on ideal and on realistic frames."""
    return tuple(
        _measure(name, Scene.build(site, settings))
        for name, settings in (("ideal", IDEAL), ("realistic", REALISTIC))
    )


def _measure(name: str, scene: Scene) -> Accuracy:
    poses, renderer = scene.poses(FRAMES, seed=11), scene.sub_renderer(noisy(scene))
    images = [scene.sub(renderer, pose, seed) for seed, pose in enumerate(poses)]
    half_square = _half_square_px(scene.site)
    others = {
        f"`cornerSubPix`, window {half}, `solvePnP`": _errors(
            scene, images, poses, subpix_pose(half)
        )
        for half in (_NARROW_PX, half_square)
    }
    others["`findChessboardCornersSB`, `solvePnP`"] = _errors(
        scene, images[:SLOW_FRAMES], poses[:SLOW_FRAMES], sector_pose
    )
    discs, other_discs = _disc_errors(scene)
    return Accuracy(
        name,
        float(np.mean([pose_bound_mm(scene, pose) for pose in poses[:BOUND_FRAMES]])),
        _errors(scene, images, poses, our_pose),
        _claimed(scene, images),
        others,
        disc_bound_mm(scene),
        discs,
        other_discs,
        _cost(scene, images, our_fit),
        {
            half: _cost(scene, images, subpix_pose(half))
            for half in (_NARROW_PX, _USUAL_PX, half_square)
        },
    )


def _half_square_px(site: Site) -> int:
    target = site.sub_target
    return round(0.5 * target.square_mm * site.sub.focal_px / target.distance_mm)


# ---------------------------------------------------------------------------- poses of the board


def our_pose(scene: Scene, image: GreyImage, expected: Pose) -> Pose:
    """As `measure_pair` does: find the board, fit its corners, fit the pose."""
    located = locate_board(image, scene.lens, scene.board, scene.corners_mm, expected)
    return resect(scene.lens, scene.corners_mm, located.view).pose


def our_fit(scene: Scene, image: GreyImage, expected: Pose) -> Pose:
    """Only the fit, from a pose right to a third of a square."""
    located = refine_board(image, scene.lens, expected, scene.board, scene.corners_mm)
    return resect(scene.lens, scene.corners_mm, located.view, expected).pose


def subpix_pose(half_window_px: int) -> Estimator:
    """Plain OpenCV from predicted corners; half_window_px as `cornerSubPix` takes it."""

    def estimate(scene: Scene, image: GreyImage, expected: Pose) -> Pose:
        index, points, _ = predict_corners(
            scene.lens, expected, scene.board, scene.corners_mm, image.pixels.shape
        )
        inside = (points > half_window_px + 1.0).all(axis=1)
        inside &= (points < np.array(image.pixels.shape[::-1]) - half_window_px - 2.0).all(axis=1)
        index, points = index[inside], points[inside]
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
        start = points.astype(np.float32).reshape(-1, 1, 2)
        window = (half_window_px, half_window_px)
        located = cv2.cornerSubPix(image.pixels, start, window, (-1, -1), stop)
        return _solve(scene, index, np.asarray(located.reshape(-1, 2), dtype=np.float64))

    return estimate


def sector_pose(scene: Scene, image: GreyImage, expected: Pose) -> Pose:
    """OpenCV's own detector of boards that reach beyond the image, helped as far as can be.

    The truth names its corners; those cut by the border and those off by a pixel are left out.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners, _ = cv2.findChessboardCornersSBWithMeta(image.pixels, (9, 9), flags)
    if not found:
        msg = "findChessboardCornersSB found no board"
        raise RuntimeError(msg)
    points = np.asarray(corners.reshape(-1, 2), dtype=np.float64)
    predicted = scene.lens.project(expected.apply(scene.corners_mm))
    away = np.hypot(*(points[:, None] - predicted).transpose(2, 0, 1))
    margin = _half_square_px(scene.site)
    good = away.min(axis=1) < 0.25 * margin
    good &= (points > margin).all(axis=1)
    good &= (points < np.array(image.pixels.shape[::-1]) - margin).all(axis=1)
    return _solve(scene, np.argmin(away, axis=1)[good], points[good])


def _solve(scene: Scene, index: IntArray, points_px: FloatArray) -> Pose:
    _, rotation, translation = cv2.solvePnP(
        scene.corners_mm[index],
        np.ascontiguousarray(points_px, dtype=np.float64),
        scene.lens.matrix,
        scene.lens.parameters[5:],
    )
    return Pose.from_vectors(np.ravel(rotation), np.ravel(translation))


def _errors(
    scene: Scene, images: Sequence[GreyImage], poses: Sequence[Pose], estimate: Estimator
) -> Errors:
    found, seconds = [], []
    for image, true in zip(images, poses, strict=True):
        started_s = time.process_time()
        # A prediction a whole drift away would name other corners.
        found.append(estimate(scene, image, _near(true)))
        seconds.append(time.process_time() - started_s)
    each = [
        scene.false_mm(here.compose(true.inverse()))
        for here, true in zip(found, poses, strict=True)
    ]
    between = []
    for j in range(1, len(found)):
        motion = found[j].compose(found[j - 1].inverse())
        truth = poses[j].compose(poses[j - 1].inverse())
        between.append(scene.false_mm(motion) - scene.false_mm(truth))
    return Errors(rms(between), rms(each), statistics.median(seconds))


def _near(true: Pose) -> Pose:
    """A pose 1 px or so off, as a prediction from the frame before would be."""
    return true.perturbed(np.array([1e-4, -1e-4, 2e-4, 0.02, -0.02, 0.03]))


def _claimed(scene: Scene, images: Sequence[GreyImage]) -> float:
    squares = []
    for image in images[:SLOW_FRAMES]:
        rest = scene.geometry.T_CS_WS
        located = locate_board(image, scene.lens, scene.board, scene.corners_mm, rest)
        fitted = resect(scene.lens, scene.corners_mm, located.view)
        to_mm = scene.false_by_pose(fitted.pose)
        squares.append(float(np.trace(to_mm @ fitted.covariance @ to_mm.T)))
    return float(np.sqrt(np.mean(squares)))


def _cost(scene: Scene, images: Sequence[GreyImage], estimate: Estimator) -> float:
    poses, seconds = scene.poses(FRAMES, seed=11), []
    for image, true in zip(images, poses, strict=True):
        expected = _near(true)
        started_s = time.process_time()
        estimate(scene, image, expected)
        seconds.append(time.process_time() - started_s)
    return statistics.median(seconds)


# --------------------------------------------------------------------------------------- discs


def our_discs(scene: Scene, image: GreyImage) -> FloatArray:
    """(discs, 2) px by the fit to their grey values."""
    return find_discs(image, scene.site.main_target, scene.site.nominal_px_per_mm).points_px


def ellipse_discs(scene: Scene, image: GreyImage) -> FloatArray:
    """(discs, 2) px by plain OpenCV: Otsu's threshold, contours, `fitEllipse`."""
    _, white = cv2.threshold(image.pixels, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(white, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    expected = np.pi * (0.5 * scene.site.main_target.diameters_mm.max() * _scale(scene)) ** 2
    fits = [
        np.array(cv2.fitEllipse(contour)[0])
        for contour in contours
        if 0.5 * expected < cv2.contourArea(contour) < 2.0 * expected
    ]
    layout = _layout_px(scene)
    found = np.array(fits)
    found_middle, layout_middle = found.mean(axis=0), layout.mean(axis=0)
    away = np.hypot(
        *((layout - layout_middle)[:, None] - (found - found_middle)).transpose(2, 0, 1)
    )
    return np.asarray(found[np.argmin(away, axis=1)])


def _scale(scene: Scene) -> float:
    return scene.site.nominal_px_per_mm


def _layout_px(scene: Scene) -> FloatArray:
    return np.asarray(scene.site.main_target.centres_mm * np.array([1.0, -1.0]) * _scale(scene))


def _disc_errors(scene: Scene) -> tuple[Errors, Errors]:
    """Ours and OpenCV's: the mean of the discs, mm at the target."""
    rng, renderer = np.random.default_rng(12), scene.main_renderer(noisy(scene))
    moves = [rng.uniform(-_MOVE_MM, _MOVE_MM, 2) for _ in range(DISC_FRAMES)]
    images = [scene.main(renderer, move, seed) for seed, move in enumerate(moves)]
    centres = scene.site.main_target.centres_mm
    results = []
    for locate in (our_discs, ellipse_discs):
        misses, seconds = [], []
        for image, move in zip(images, moves, strict=True):
            started_s = time.process_time()
            points = locate(scene, image)
            seconds.append(time.process_time() - started_s)
            world = np.column_stack([centres + move, np.zeros(len(centres))])
            truth = scene.geometry.main.project(scene.geometry.T_CM_WM.apply(world))
            to_px, _ = affine(centres, truth)
            misses.append(np.linalg.solve(to_px, (points - truth).mean(axis=0)))
        between = np.diff(np.array(misses), axis=0)
        results.append(Errors(rms(list(between)), rms(misses), statistics.median(seconds)))
    return results[0], results[1]


def rms(vectors: Sequence[FloatArray]) -> float:
    """Root mean square length."""
    return float(np.sqrt(np.mean([v @ v for v in vectors])))
