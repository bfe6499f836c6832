"""Main targets rendered in any pose, as the small site's main camera sees them, with the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.images import GreyImage
from core.site import CirclesTarget
from drivers.sim.geometry import FLIP_Y_Z, TrueLens
from drivers.sim.kernels import Float32Array
from drivers.sim.render import MARGIN_PX, CameraRenderer, Look
from drivers.sim.settings import Sensor
from tests.core.scenes import CENTRES_MM, small_site

CAMERA = small_site().main
PX_PER_MM = small_site().nominal_px_per_mm
TARGET = CirclesTarget(CENTRES_MM, np.full(5, 8.0), 11000.0, 20.0)
LENS = TrueLens(CAMERA.focal_px, CAMERA.focal_px, 321.0, 198.5, np.zeros(5))
EVEN = Look(0.75, 1.0, 0.0, 0.0)
FULL_PLATE = 14.0
"""mm of black beyond the outermost centres."""
SENSOR = Sensor()


@dataclass(frozen=True, slots=True)
class TargetScene:
    """White discs on a black plate in front of something grey."""

    target: CirclesTarget = TARGET
    roll_deg: float = 0.0
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    middle_mm: tuple[float, float] = (0.0, 0.0)
    """Where the target's centre is in CM, mm right and down."""
    hidden: tuple[int, ...] = ()
    """Discs that something black covers."""
    spots_mm: tuple[tuple[float, float, float], ...] = ()
    """Further white discs in WM: x, y, radius."""
    greys: tuple[float, float, float] = (0.73, 0.03, 0.28)
    """White, black, and what is behind the plate."""
    look: Look = EVEN
    sensor: Sensor = SENSOR
    light: float = 1.0

    @property
    def pose(self) -> Pose:
        """`T_CM_WM`."""
        turn = Rotation.from_euler("xyz", [*self.tilt_deg, self.roll_deg], degrees=True)
        x, y = self.middle_mm
        return Pose(turn.as_matrix() @ FLIP_Y_Z, np.array([x, y, self.target.distance_mm]))

    @property
    def centres_px(self) -> FloatArray:
        """(n, 2) true images of the centres."""
        centres = self.target.centres_mm
        return LENS.project(self.pose.apply(np.column_stack([centres, np.zeros(len(centres))])))

    def reflectance(self, renderer: CameraRenderer) -> Float32Array:
        """The scene before light and lens."""
        discs = np.column_stack([self.target.centres_mm, self.target.diameters_mm / 2.0])
        shown = np.delete(discs, list(self.hidden), axis=0)
        shown = np.concatenate([shown, np.array(self.spots_mm).reshape(-1, 3)])
        low, high = discs[:, :2].min(axis=0), discs[:, :2].max(axis=0)
        plate = np.concatenate([low - FULL_PLATE, high + FULL_PLATE])
        return renderer.discs(self.pose, shown, plate, np.array(self.greys))

    def image(self, seed: int = 0) -> GreyImage:
        """What the camera sees."""
        return self.images(1, seed)[0]

    def images(
        self, count: int, seed: int = 0, light: Float32Array | None = None
    ) -> list[GreyImage]:
        """Images of the same scene with different noise; `light` (h, w) is a pattern of light."""
        rng = np.random.default_rng(seed)
        renderer = CameraRenderer(CAMERA, LENS, self.look, self.sensor)
        lit = renderer.lit(self.reflectance(renderer), self.light)
        if light is not None:
            lit *= np.pad(light, MARGIN_PX, mode="edge")
        return [
            GreyImage(renderer.expose(lit.copy(), 0.01, rng), self.sensor.bits)
            for _ in range(count)
        ]

    def with_hidden(self, *discs: int) -> TargetScene:
        """The same with discs covered."""
        return replace(self, hidden=discs)
