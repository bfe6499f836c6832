"""A site as drawn, seen without images: views projected, with the noise that images would have."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.calibration.joint_fit import nominal_rig
from core.calibration.views import LensView, PairView, Views
from core.checkerboard.board import Board
from core.checkerboard.corners import LocatedBoard
from core.checkerboard.resection import BoardView, visible_corners
from core.discs.disc_finder import Discs
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.images import GreyImage
from core.lens_model import LensModel
from core.rig.rigid import Rig
from core.site import Site

PIVOT_BELOW_MM = 100.0
"""Where the head's axes are taken to meet: so far below the middle between the cameras."""
HELD_TILT_DEG = 25.0
"""Largest tilt of a board in the hand: what docs/pier.md asks for."""
HELD_NEAR, HELD_FAR = 1.05, 1.4
"""A board in the hand is held at these multiples of the distance at which it fills the image."""
OUTLINE = 1.2
"""Of a disc's radius: its edge must be in the image with what is around it."""
_GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))
"""Golden angle: directions so far apart spread evenly, however many there are."""
_EDGE_SHARE = 0.92
"""Of a square's side: the length of edge that locates a corner each way; chosen a little less
than the square, as the blurred crossing says less."""
_LEAST_TILT_SHARE = 0.1
"""Of the tilt, squared, of the first view in the hand: none is quite square on."""
_SPARE_SHARE, _OVER_SHARE = 0.8, 0.05
"""How far a board in the hand is moved aside: of the space beside it, and of the image."""
_NO_IMAGE = GreyImage(np.zeros((1, 1), np.uint8))
"""Stands where a view has an image: nothing is read from it."""

Position = tuple[float, float]
"""Pan and tilt, degrees."""


# ------------------------------------------------------------------------- what images will tell


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """The noise model: all that is taken for granted about images that nobody has taken yet.

    An edge of contrast C (white less black) whose profile is a Gaussian of width b tells a shift
    across it with the information C^2 / (2 sqrt(pi) b n^2) per pixel of its length, n being the
    noise of a grey value (Cramer-Rao; the integral of the squared profile). The defaults are
    those of 8 bits, a well exposed and evenly lit board, and a sharp lens.
    """

    contrast_dn: float = 150.0
    noise_dn: float = 1.0
    blur_px: float = 0.85
    """The pixel's own square counted in."""
    fit_loss: float = 1.2
    """Sigma of the fit to grey values over the bound: its own light and blur for each corner."""

    def edge_sigma_px(self, edge_px: FloatArray) -> FloatArray:
        """1 sigma of a shift across edges of these lengths, px."""
        bell = 2.0 * math.sqrt(math.pi) * self.blur_px
        per_px = (self.contrast_dn / (self.fit_loss * self.noise_dn)) ** 2 / bell
        return np.asarray(1.0 / np.sqrt(per_px * edge_px))

    def corner_sigma_px(self, square_px: FloatArray) -> FloatArray:
        """1 sigma of each coordinate of a corner: an edge of nearly a square either way."""
        return self.edge_sigma_px(_EDGE_SHARE * square_px)

    def disc_sigma_px(self, radius_px: FloatArray) -> FloatArray:
        """1 sigma of each coordinate of a disc: half its outline lies across either."""
        return self.edge_sigma_px(math.pi * radius_px)


@dataclass(frozen=True, slots=True)
class CalibrationPlan:
    """The calibration that is planned."""

    lens_views: int
    positions_deg: tuple[Position, ...]
    """Pan and tilt of the rig views."""


# -------------------------------------------------------------------------------- views as drawn


@dataclass(frozen=True, slots=True)
class PlannedSite:
    """A site as drawn, seen without images."""

    site: Site
    quality: ImageQuality

    @property
    def lens(self) -> Lens:
        """The sub-camera's lens as drawn: of the config's kind, free of distortion."""
        sub, model = self.site.sub, self.site.lens_model or LensModel.BROWN
        return Lens.ideal(model, sub.focal_px, sub.centre_px)

    @property
    def board(self) -> Board:
        """The board as drawn."""
        return Board.nominal(self.site.sub_target)

    @property
    def rig(self) -> Rig:
        """The rig as drawn."""
        scale = self.site.nominal_px_per_mm
        return nominal_rig(self.site, np.diag([scale, -scale]))

    @property
    def T_CS1_WS(self) -> Pose:
        """The board squarely before the sub-camera."""
        target = self.site.sub_target
        size_mm = np.array([target.squares_x, target.squares_y]) * target.square_mm
        return Pose(np.eye(3), np.append(-size_mm / 2.0, target.distance_mm))

    @property
    def reference_discs_px(self) -> FloatArray:
        """(discs, 2) the main target in the middle of its image."""
        flipped = self.site.main_target.centres_mm * np.array([1.0, -1.0])
        return np.asarray(self.site.main.centre_px + self.site.nominal_px_per_mm * flipped)

    def head_motion(self, position: Position) -> Pose:
        """`T_CSj_CS1` of the head at a position: T = (I - R) c about its pivot c."""
        pan, tilt = np.radians(position)
        main_CS = self.rig.T_CM_CS.inverse().t_mm
        pivot = 0.5 * main_CS + np.array([0.0, PIVOT_BELOW_MM, 0.0])
        R = Pose.from_vectors(np.array([tilt, 0.0, 0.0]), np.zeros(3)).R
        R = R @ Pose.from_vectors(np.array([0.0, pan, 0.0]), np.zeros(3)).R
        return Pose(R, pivot - R @ pivot)

    def lens_view_pose(self, number: int, count: int) -> Pose:
        """`T_CS_WS` of lens view `number`: tilted every way, near and far, all over the image."""
        target, camera = self.site.sub_target, self.site.sub
        size_mm = np.array([target.squares_x, target.squares_y]) * target.square_mm
        view_px = np.array([camera.width_px, camera.height_px])
        around, share = number * _GOLDEN_RAD, (number + 0.5) / count
        tilt_rad = math.radians(HELD_TILT_DEG) * math.sqrt(
            _LEAST_TILT_SHARE + (1.0 - _LEAST_TILT_SHARE) * share
        )
        axis = np.array([math.cos(around), math.sin(around), 0.0])
        R = Pose.from_vectors(tilt_rad * axis, np.zeros(3)).R
        between = (number * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
        near = float(np.max(size_mm * camera.focal_px / view_px))
        depth_mm = near * (HELD_NEAR + (HELD_FAR - HELD_NEAR) * between)
        spare_px = np.maximum(view_px - size_mm * camera.focal_px / depth_mm, 0.0)
        where = 0.5 * np.array([math.cos(2.0 * around), math.sin(3.0 * around)])
        shift_px = where * (_SPARE_SHARE * spare_px + _OVER_SHARE * view_px)
        middle = np.append(shift_px / camera.focal_px, 1.0) * depth_mm
        return Pose(R, middle - R @ np.append(size_mm / 2.0, 0.0))

    def predict_board(self, T_CS_WS: Pose) -> LocatedBoard:
        """The corners in the sub image."""
        size_px = self.site.sub.width_px, self.site.sub.height_px
        corners_mm = self.board.corners_mm
        index, points = visible_corners(self.lens, T_CS_WS, corners_mm, size_px)
        depth_mm = T_CS_WS.apply(corners_mm[index])[:, 2]
        square_px = self.site.sub.focal_px * self.site.sub_target.square_mm / depth_mm
        variance = self.quality.corner_sigma_px(square_px) ** 2
        view = BoardView(index, points, variance[:, None, None] * np.eye(2))
        q = self.quality
        return LocatedBoard(
            view,
            unambiguous=True,
            white_dn=np.full(len(index), q.contrast_dn),
            black_dn=np.zeros(len(index)),
            missing_px=np.zeros((0, 2)),
            noise_dn=q.noise_dn,
            contrast_dn=q.contrast_dn,
            blur_px=q.blur_px,
        )

    def predict_discs(self, motion: Pose) -> Discs:
        """The discs in the main image, the target at rest, the rig moved by `T_CSj_CS1`."""
        points = self.rig.move(self.reference_discs_px, motion)
        q, camera = self.quality, self.site.main
        radius_px = 0.5 * self.site.main_target.diameters_mm * self.site.nominal_px_per_mm
        edge = OUTLINE * radius_px[:, None]
        size = np.array([camera.width_px, camera.height_px])
        found = np.asarray(((points > edge) & (points < size - 1.0 - edge)).all(axis=1))
        points[~found] = np.nan
        covariance = (q.disc_sigma_px(radius_px) ** 2)[:, None, None] * np.eye(2)
        return Discs(found, points, covariance, found.astype(float), q.contrast_dn, q.blur_px)

    def predict_pair(self, name: str, motion: Pose) -> PairView:
        """Both targets."""
        board = self.predict_board(motion.compose(self.T_CS1_WS))
        return PairView(name, _NO_IMAGE, board, self.predict_discs(motion))

    def poses(self, calibration_plan: CalibrationPlan) -> list[Pose]:
        """`T_CS_WS` of all views of a calibration, in the order of `Views.all`."""
        count = calibration_plan.lens_views
        moved = [self.head_motion(p).compose(self.T_CS1_WS) for p in calibration_plan.positions_deg]
        return [self.T_CS1_WS, *moved, *(self.lens_view_pose(k, count) for k in range(count))]

    def views(self, calibration_plan: CalibrationPlan) -> Views:
        """All views of a calibration."""
        count = calibration_plan.lens_views
        return Views(
            self.predict_pair("reference", Pose.identity()),
            tuple(
                self.predict_pair(f"rig {k + 1}", self.head_motion(position))
                for k, position in enumerate(calibration_plan.positions_deg)
            ),
            tuple(
                LensView(
                    f"lens {k + 1}", _NO_IMAGE, self.predict_board(self.lens_view_pose(k, count))
                )
                for k in range(count)
            ),
        )
