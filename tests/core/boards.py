"""Boards rendered in any pose, as the small site's sub-camera sees them, with the truth in px."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray, IntArray
from core.checkerboard.board import Board
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.images import GreyImage
from core.site import CheckerboardTarget
from drivers.sim.effects import draw_insect
from drivers.sim.geometry import TrueBoard, TrueLens
from drivers.sim.render import CameraRenderer, Look
from drivers.sim.settings import Sensor
from tests.core.scenes import small_site

CAMERA = small_site().sub
TARGET = small_site().sub_target
LENS = TrueLens(515.0, 514.5, 241.2, 147.8, np.array([-0.09, 0.02, 3e-4, -2e-4, -0.002]))
AS_CORE = Lens(np.array([515.0, 514.5, 0.0, 241.2, 147.8, -0.09, 0.02, 3e-4, -2e-4, -0.002]))
EVEN = Look(0.65, 1.0, 0.0, 0.0)
SENSOR = Sensor()


@dataclass(frozen=True, slots=True)
class BoardScene:
    """A nominal board before the sub-camera."""

    target: CheckerboardTarget = TARGET
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector of the board, degrees."""
    middle_mm: tuple[float, float, float] = (0.0, 0.0, 52.0)
    """The board's middle in CS."""
    look: Look = EVEN
    sensor: Sensor = SENSOR
    light: float = 1.0
    insect_px: tuple[float, float, float] | None = None
    """Place and length of an insect."""

    @property
    def pose(self) -> Pose:
        """`T_CS_WS`."""
        R = Rotation.from_rotvec(self.turn_deg, degrees=True).as_matrix()
        size_mm = np.array([self.target.squares_x, self.target.squares_y, 0.0])
        return Pose(R, np.array(self.middle_mm) - R @ (size_mm * self.target.square_mm / 2.0))

    @property
    def board(self) -> Board:
        """The board as the core knows it."""
        return Board.nominal(self.target)

    @property
    def corners_px(self) -> FloatArray:
        """(corners, 2) true images of all inner corners."""
        return LENS.project(self.pose.apply(self.board.corners_mm))

    def inside(self, margin_px: float) -> IntArray:
        """Indices of the corners at least so far inside the image."""
        size = np.array([CAMERA.width_px, CAMERA.height_px]) - 1 - margin_px
        px = self.corners_px
        return np.nonzero(((px > margin_px) & (px < size)).all(axis=1))[0]

    def image(self, seed: int = 0) -> GreyImage:
        """What the camera sees."""
        return self.images(1, seed)[0]

    def images(self, count: int, seed: int = 0) -> list[GreyImage]:
        """Images of the same scene with different noise."""
        rng = np.random.default_rng(seed)
        renderer = CameraRenderer(CAMERA, LENS, self.look, self.sensor)
        lines = [
            np.arange(n + 1) * self.target.square_mm
            for n in (self.target.squares_x, self.target.squares_y)
        ]
        scene = renderer.board(self.pose, TrueBoard(lines[0], lines[1], 0.0), 0.75, 0.05)
        if self.insect_px is not None:
            draw_insect(scene, np.array(self.insect_px[:2]), self.insect_px[2], rng)
        lit = renderer.lit(scene, self.light)
        return [
            GreyImage(renderer.expose(lit.copy(), 0.01, rng), self.sensor.bits)
            for _ in range(count)
        ]

    def moved(self, x_mm: float, y_mm: float) -> BoardScene:
        """The same board shifted in CS."""
        x, y, z = self.middle_mm
        return replace(self, middle_mm=(x + x_mm, y + y_mm, z))
