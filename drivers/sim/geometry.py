"""The true rig: what was built, as against what the drawing and the survey say of it.

Conventions as everywhere: WM x right, y up, z towards the camera; WS x right, y down, z into the
board; cameras x right, y down, z forward; pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.site import CameraGeometry, CheckerboardTarget, CirclesTarget, Site
from drivers.sim.settings import AsBuilt, Print, SimSettings

FLIP_Y_Z = np.diag([1.0, -1.0, -1.0])
"""R_CM_WM of a target that squarely faces the main camera."""

HELD_TILT_DEG = 25.0
"""Largest tilt of a board held in the hand."""

REFOCUS = 0.001
"""1 sigma by which refocusing changes a focal length, and shifts the principal point as a share of
the image's width."""


@dataclass(frozen=True, slots=True)
class TrueLens:
    """A pinhole camera with OpenCV's five distortion coefficients."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: FloatArray
    """(5,) k1, k2, p1, p2, k3."""

    def project(self, points_mm: FloatArray) -> FloatArray:
        """Project points (n, 3) of the camera frame to pixels (n, 2)."""
        x, y = points_mm[:, 0] / points_mm[:, 2], points_mm[:, 1] / points_mm[:, 2]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([self.fx_px * xd + self.cx_px, self.fy_px * yd + self.cy_px], axis=1)


@dataclass(frozen=True, slots=True)
class TrueBoard:
    """A printed checkerboard: each line has its own error, and the sheet is bowed."""

    x_lines_mm: FloatArray
    """(squares_x + 1,) positions of the vertical lines in WS."""
    y_lines_mm: FloatArray
    """(squares_y + 1,) positions of the horizontal lines in WS."""
    bow_mm: float

    @property
    def size_mm(self) -> FloatArray:
        """(2,) printed width and height."""
        return np.array([self.x_lines_mm[-1] - self.x_lines_mm[0], np.ptp(self.y_lines_mm)])

    def depth_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Depth z in WS of the bowed sheet, any shape: `bow` in the middle, 0 in the corners."""
        half = self.size_mm / 2.0
        xi = (x_mm - self.x_lines_mm[0]) / half[0] - 1.0
        eta = (y_mm - self.y_lines_mm[0]) / half[1] - 1.0
        return np.asarray(self.bow_mm * (1.0 - 0.5 * (xi * xi + eta * eta)))

    def corners_mm(self) -> FloatArray:
        """All line crossings (squares_y + 1, squares_x + 1, 3) in WS, the border included."""
        x, y = np.meshgrid(self.x_lines_mm, self.y_lines_mm)
        return np.stack([x, y, self.depth_mm(x, y)], axis=-1)


@dataclass(frozen=True, slots=True)
class TrueGeometry:
    """Everything that stays as it was built."""

    main: TrueLens
    sub: TrueLens
    T_CM_CS: Pose
    T_CM_WM: Pose
    """The main target against the main camera, rig and bridge at rest."""
    T_CS_WS: Pose
    """The board against the sub-camera, rig at rest."""
    board: TrueBoard
    pan_axis: Pose
    """Pan axis frame in CS at rest: turns about its y axis."""
    tilt_axis: Pose
    """Tilt axis frame in CS at rest: turns about its x axis."""

    def head_pose(self, pan_deg: float, tilt_deg: float) -> Pose:
        """`T_CS1_CSj` for the head turned from rest: the tilt axis rides on the pan axis."""
        pan = _turn_about(self.pan_axis, np.array([0.0, -math.radians(pan_deg), 0.0]))
        tilt = _turn_about(self.tilt_axis, np.array([math.radians(tilt_deg), 0.0, 0.0]))
        return pan.compose(tilt)


def build_geometry(site: Site, settings: SimSettings) -> TrueGeometry:
    """Build a rig from a drawing: each departure within its sigma, all from the seed."""
    rng = np.random.default_rng([settings.seed, 1])
    built = settings.as_built
    draw = Draw(rng, built.scale)
    T_CM_CS = Pose(
        Rotation.from_rotvec(draw(np.radians(np.full(3, site.rig.rotation_sigma_deg)))).as_matrix()
        @ Rotation.from_euler("xyz", site.rig.rotation_main_sub_deg, degrees=True).as_matrix(),
        site.rig.offset_main_sub_mm + draw(np.full(3, site.rig.offset_sigma_mm)),
    )
    head = settings.head
    axis_sigma_rad = np.full(3, math.radians(head.misalignment_deg))
    return TrueGeometry(
        main=_lens(site.main, draw, built.main_focal, np.zeros(5), built.centre_px_per_1000),
        sub=_lens(
            site.sub,
            draw,
            built.sub_focal,
            np.asarray(built.sub_distortion) * (1.0 + draw(np.full(5, 0.1))),
            built.centre_px_per_1000,
        ),
        T_CM_CS=T_CM_CS,
        T_CM_WM=_main_target(site.main_target, draw, built),
        T_CS_WS=_sub_target(site.sub_target, draw, built),
        board=_board(site.sub_target, settings.print, draw),
        pan_axis=Pose.from_vectors(draw(axis_sigma_rad), np.asarray(head.pan_axis_mm)),
        tilt_axis=Pose.from_vectors(draw(axis_sigma_rad), np.asarray(head.tilt_axis_mm)),
    )


def bonded_again(site: Site, settings: SimSettings, number: int) -> Pose:
    """`T_CS_WS` of the board bonded to the pier once more, about where it was."""
    draw = Draw(np.random.default_rng([settings.seed, 14, number]), settings.as_built.scale)
    return _sub_target(site.sub_target, draw, settings.as_built)


def refocused(lens: TrueLens, camera: CameraGeometry, rng: np.random.Generator) -> TrueLens:
    """Give a lens after somebody has turned its focus ring: another focal length and centre."""
    scale = 1.0 + REFOCUS * rng.standard_normal()
    shift_px = REFOCUS * camera.width_px * rng.standard_normal(2)
    return replace(
        lens,
        fx_px=lens.fx_px * scale,
        fy_px=lens.fy_px * scale,
        cx_px=lens.cx_px + float(shift_px[0]),
        cy_px=lens.cy_px + float(shift_px[1]),
    )


def held_board_pose(site: Site, geometry: TrueGeometry, rng: np.random.Generator) -> Pose:
    """`T_CS_WS` of the board held by hand before the sub-camera: tilted, anywhere in view."""
    axis = rng.normal(size=2)
    tilt_rad = math.radians(HELD_TILT_DEG) * math.sqrt(rng.uniform(0.1, 1.0))
    tilt = Rotation.from_rotvec(np.append(axis / np.hypot(*axis) * tilt_rad, 0.0))
    roll = Rotation.from_rotvec([0.0, 0.0, math.radians(rng.uniform(-8.0, 8.0))])
    R = (tilt * roll).as_matrix()
    view_px = np.array([site.sub.width_px, site.sub.height_px])
    fill_mm = float(np.max(geometry.board.size_mm * site.sub.focal_px / view_px))
    depth_mm = fill_mm * rng.uniform(1.05, 1.4)
    spare_px = np.maximum(view_px - geometry.board.size_mm * site.sub.focal_px / depth_mm, 0.0)
    shift_px = rng.uniform(-0.5, 0.5, 2) * (0.8 * spare_px + 0.05 * view_px)
    middle = np.append(shift_px / site.sub.focal_px, 1.0) * depth_mm
    return Pose(R, middle - R @ np.append(geometry.board.size_mm / 2.0, 0.0))


class Draw:
    """Normal deviates, cut off so that a departure is fairly within its stated sigma."""

    def __init__(self, rng: np.random.Generator, scale: float) -> None:
        self._rng = rng
        self.scale = scale

    def __call__(self, sigma: FloatArray, limit: float = 1.5) -> FloatArray:
        """Give a deviate for each sigma."""
        return self.scale * sigma * np.clip(self._rng.normal(size=sigma.shape), -limit, limit)


def _lens(
    camera: CameraGeometry,
    draw: Draw,
    focal_sigma: float,
    distortion: FloatArray,
    centre_px_per_1000: float,
) -> TrueLens:
    focal_px = camera.focal_px * (1.0 + draw(np.array([focal_sigma]))[0])
    shift_px = draw(np.full(2, centre_px_per_1000 * camera.width_px / 1000.0))
    return TrueLens(
        fx_px=focal_px,
        fy_px=focal_px * (1.0 + draw(np.array([1e-4]))[0]),
        cx_px=(camera.width_px - 1) / 2.0 + shift_px[0],
        cy_px=(camera.height_px - 1) / 2.0 + shift_px[1],
        distortion=distortion,
    )


def _main_target(target: CirclesTarget, draw: Draw, built: AsBuilt) -> Pose:
    turn = Rotation.from_rotvec(draw(np.radians(np.full(3, built.target_tilt_deg))))
    aim_mm = draw(np.full(2, built.aim_mm))
    depth_mm = target.distance_mm + draw(np.array([target.distance_sigma_mm]))
    return Pose(turn.as_matrix() @ FLIP_Y_Z, np.concatenate([aim_mm, depth_mm]))


def _sub_target(target: CheckerboardTarget, draw: Draw, built: AsBuilt) -> Pose:
    R = Rotation.from_rotvec(draw(np.radians(np.full(3, built.target_tilt_deg)))).as_matrix()
    half_mm = np.array([target.squares_x, target.squares_y, 0.0]) * target.square_mm / 2.0
    middle = np.array([0.0, 0.0, target.distance_mm]) + draw(np.full(3, built.board_offset_mm))
    return Pose(R, middle - R @ half_mm)


def _board(target: CheckerboardTarget, printed: Print, draw: Draw) -> TrueBoard:
    scale = 1.0 + np.clip(draw(np.full(2, printed.scale_error)), -0.001, 0.001)
    error_mm = printed.line_error_um / 1000.0
    x = np.arange(target.squares_x + 1) * target.square_mm * scale[0]
    y = np.arange(target.squares_y + 1) * target.square_mm * scale[1]
    return TrueBoard(
        x_lines_mm=x + draw(np.full(x.shape, error_mm), limit=4.0),
        y_lines_mm=y + draw(np.full(y.shape, error_mm), limit=4.0),
        bow_mm=printed.bow_um / 1000.0 * draw.scale,
    )


def _turn_about(axis: Pose, rotation_rad: FloatArray) -> Pose:
    turn = Pose.from_vectors(rotation_rad, np.zeros(3))
    return axis.compose(turn).compose(axis.inverse())
