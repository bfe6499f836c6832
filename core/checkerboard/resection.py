"""The pose of a board with known corners from one image (Eq. 11)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.checkerboard.pose_kernels import pose_normal, whiten_residuals
from core.errors import TargetNotFoundError
from core.geometry.lens import Lens
from core.geometry.pose import Pose, skew_matrix

MARGIN_PX = 2.0
"""Nearer to the edge of an image no corner is measured: its edges would be cut off."""
MIN_CORNERS = 8
"""Of a pose. Four determine it; so many leave ten residuals to tell a wrong one by."""
POSITION_FLOOR_PX = 0.0005
"""1 sigma that a located corner has at least, however low the noise: the grey-value model's own
error. Halved or doubled, values move by 0.0004 mm at most and sigmas by 1 % (measured)."""
FULL_WEIGHT_SIGMAS = 3.0
"""Residuals up to here have full weight; 1.1 % of two-dimensional normal noise lies beyond."""
_RAYLEIGH_MEDIAN = 1.1774
"""Median of the norm of two normal variables of unit variance, sqrt(2 ln 2)."""
_PRIOR_RESIDUALS = 50.0
"""The predicted noise counts as so many residuals. Chosen; insensitive."""
_ITERATIONS = 12
"""From a near pose three or four settle; the rest is for starts that are a square off."""


@dataclass(frozen=True, slots=True)
class BoardView:
    """Corners of the board located in one image."""

    index: IntArray
    """(n,) index into Board.corners_mm."""
    points_px: FloatArray
    """(n, 2)."""
    covariance_px2: FloatArray
    """(n, 2, 2)."""

    def select(self, keep: BoolArray) -> BoardView:
        """Give the view of some of the corners."""
        return BoardView(self.index[keep], self.points_px[keep], self.covariance_px2[keep])

    def whitening(self) -> FloatArray:
        """(n, 2, 2) matrices that make the residuals of unit variance."""
        floor = POSITION_FLOOR_PX**2
        uu, vv = self.covariance_px2[:, 0, 0] + floor, self.covariance_px2[:, 1, 1] + floor
        uv = self.covariance_px2[:, 0, 1]
        whiten = np.zeros_like(self.covariance_px2)
        whiten[:, 0, 0] = 1.0 / np.sqrt(uu)
        whiten[:, 1, 1] = 1.0 / np.sqrt(vv - uv * uv / uu)
        whiten[:, 1, 0] = -whiten[:, 1, 1] * uv / uu
        return whiten


@dataclass(frozen=True, slots=True)
class BoardPose:
    """`T_CS_WS` of one image with its uncertainty."""

    pose: Pose
    covariance: FloatArray
    """(6, 6) of (rotation about the CS axes rad, translation mm), see Pose.perturbed."""
    residuals_px: FloatArray
    """(n, 2) located minus projected."""
    weights: FloatArray
    """(n,) 0 to 1, low for corners that do not fit the others."""
    variance_factor: float
    """Squared ratio of the residuals to their predicted size."""

    @property
    def median_rms_px(self) -> float:
        """One coordinate's residual by the median, no corner weighed down."""
        return float(np.median(np.hypot(*self.residuals_px.T))) / _RAYLEIGH_MEDIAN

    @property
    def rms_px(self) -> float:
        """Weighted rms of one coordinate's residual."""
        squares = (self.residuals_px**2).sum(axis=1) / 2.0
        return float(np.sqrt((self.weights * squares).sum() / self.weights.sum()))


def robust_weights(norm: FloatArray) -> FloatArray:
    """Full weight up to 3 standard deviations, then fading as (3 / norm)^4 (Geman-McClure).

    >>> robust_weights(np.array([0.5, 3.0, 6.0])).tolist()
    [1.0, 1.0, 0.0625]
    """
    return np.asarray(np.minimum(1.0, (FULL_WEIGHT_SIGMAS / np.maximum(norm, 1e-9)) ** 4))


def robust_scale(norm: FloatArray) -> float:
    """Ratio of residual norms (n,) of 2-vectors to their predicted size, by their median.

    A ratio below 1 (noise predicted too large) is drawn towards 1, the more so the fewer they are.
    """
    ratio, n = float(np.median(norm)) / _RAYLEIGH_MEDIAN, len(norm)
    if ratio >= 1.0:
        return ratio
    return float(np.sqrt((n * ratio**2 + _PRIOR_RESIDUALS) / (n + _PRIOR_RESIDUALS)))


def initial_pose(lens: Lens, points_mm: FloatArray, points_px: FloatArray) -> Pose:
    """Pose from a plane's homography, without a guess. Raises TargetNotFoundError."""
    return pose_from_rays(lens.rays(points_px), points_mm)


def pose_from_rays(rays: FloatArray, points_mm: FloatArray) -> Pose:
    """Pose of points on a plane (n, 3) seen in directions (n, 3). Raises TargetNotFoundError."""
    ahead = _turn_to_axis(rays.mean(axis=0))  # a fisheye sees boards beside it, too
    turned = rays @ ahead.T
    ok, rotation, translation = cv2.solvePnP(
        points_mm, turned[:, :2] / turned[:, 2:], np.eye(3), None, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not ok or translation[2, 0] <= 0:
        msg = "sub target: no pose fits the corners found"
        raise TargetNotFoundError(msg)
    found = Pose.from_vectors(
        np.asarray(rotation[:, 0], dtype=float), np.asarray(translation[:, 0], dtype=float)
    )
    return Pose(ahead.T, np.zeros(3)).compose(found)


def _turn_to_axis(direction: FloatArray) -> FloatArray:
    """(3, 3) the rotation that takes a direction to the z axis by the shortest way."""
    z = direction / np.linalg.norm(direction)
    axis = np.array([z[1], -z[0], 0.0])
    cross = skew_matrix(axis)
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + z[2]))


def pose_jacobian(lens: Lens, pose: Pose, points_mm: FloatArray) -> tuple[FloatArray, ...]:
    """Projection (n, 2), its derivatives by pose (n, 2, 6), point (n, 2, 3), lens (n, 2, size)."""
    rotated = points_mm @ pose.R.T
    projected, by_camera_point, by_lens = lens.project_jacobians(rotated + pose.t_mm)
    by_pose = np.empty((len(points_mm), 2, 6))
    by_pose[:, :, :3] = -by_camera_point @ skew_matrix(rotated)
    by_pose[:, :, 3:] = by_camera_point
    return projected, by_pose, by_camera_point @ pose.R, by_lens


def visible_corners(
    lens: Lens, pose: Pose, corners_mm: FloatArray, size_px: tuple[int, int]
) -> tuple[IntArray, FloatArray]:
    """Indices (n,) and images (n, 2), px, of the corners that a pose puts into an image.

    corners_mm (m, 3); size_px is the image's width and height. Corners within MARGIN_PX of its
    edge are left out.
    """
    in_camera = pose.apply(corners_mm)
    index = np.nonzero(lens.sees(in_camera))[0]
    points = lens.project(in_camera[index])
    far = np.array(size_px) - 1.0 - MARGIN_PX
    inside = ((points > MARGIN_PX) & (points < far)).all(axis=1)
    return index[inside], points[inside]


def resect(
    lens: Lens,
    corners_mm: FloatArray,
    view: BoardView,
    start: Pose | None = None,
    settled: float = 1e-9,
) -> BoardPose:
    """Fit the pose to the located corners by robust Gauss-Newton.

    corners_mm (m, 3) are all corners of the board. Corners off by many standard deviations
    fade out. A step below `settled` (rad, mm) is the last. Raises TargetNotFoundError with fewer
    than 8 corners, or if no pose fits them. Source: Eq. 11; weights as `robust_weights`.

    >>> from core.checkerboard.board import Board
    >>> from core.lens_model import LensModel
    >>> lens = Lens.ideal(LensModel.BROWN, 1000.0, (320.0, 240.0))
    >>> corners_mm = Board.of_squares(10, 7, 30.0).corners_mm
    >>> pose = Pose.from_vectors(np.array([0.2, -0.1, 0.0]), np.array([-120.0, -90.0, 800.0]))
    >>> points_px = lens.project(pose.apply(corners_mm))
    >>> view = BoardView(np.arange(54), points_px, np.tile(0.01**2 * np.eye(2), (54, 1, 1)))
    >>> (resect(lens, corners_mm, view).pose.vector.round(6) + 0.0).tolist()
    [0.2, -0.1, 0.0, -120.0, -90.0, 800.0]
    """
    if len(view.index) < MIN_CORNERS:
        msg = f"sub target: {len(view.index)} corners located, {MIN_CORNERS} are needed"
        raise TargetNotFoundError(msg)
    points = corners_mm[view.index]
    try:
        near = start or initial_pose(lens, points, view.points_px)
        return _resect(lens, points, view, near, settled)
    except np.linalg.LinAlgError as error:
        msg = "sub target: no pose fits the corners found"
        raise TargetNotFoundError(msg) from error


def _resect(
    lens: Lens, points: FloatArray, view: BoardView, pose: Pose, settled: float
) -> BoardPose:
    whiten = view.whitening()
    white, norm = np.empty_like(view.points_px), np.empty(len(points))
    normal, right = np.empty((6, 6)), np.empty(6)
    for _ in range(_ITERATIONS):
        rotated = points @ pose.R.T
        projected, by_point = lens.project_slopes(rotated + pose.t_mm)
        residual = view.points_px - projected
        whiten_residuals(residual, whiten, white, norm)
        scale = robust_scale(norm)
        weights = robust_weights(norm / scale)
        pose_normal(rotated, by_point, whiten, white, weights, normal, right)
        step = np.linalg.solve(normal, right)
        pose = pose.perturbed(step)
        if float(np.abs(step).max()) < settled:
            break
    return BoardPose(pose, np.linalg.inv(normal) * scale**2, residual, weights, float(scale**2))
