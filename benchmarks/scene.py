"""One simulated site whose frames, clean or noisy, can be rendered at any pose of the rig."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.images import GreyImage
from core.rig.rigid import Rig, motion_by_pose
from core.site import Site
from drivers.sim.geometry import TrueGeometry, build_geometry
from drivers.sim.plates import PLATE_MARGIN
from drivers.sim.render import CameraRenderer, Look
from drivers.sim.settings import AsBuilt, Optics, Print, Sensor, SimSettings

CLEAN = Sensor(bits=16, noise=False)
"""Fine enough steps that differences of images are derivatives."""
DRIFT_MRAD, DRIFT_MM = 1.0, 1.5
"""Largest turn and shift of a frame from the reference, each axis, evenly spread."""

IDEAL = SimSettings(
    print=Print(line_error_um=0.0, scale_error=0.0, bow_um=0.0),
    as_built=AsBuilt(scale=0.0, sub_distortion=(0.0, 0.0, 0.0, 0.0, 0.0)),
    optics=Optics(corner_blur=1.0, main_shading=0.0, sub_shading=0.0, sub_blur_px=0.75),
)
"""Even light and blur, a flat and true print, no distortion; noise as ever."""
MOUNTED_DEG = (1.3, -0.9, 1.1)
"""How a board as drawn is turned: edges along pixel rows would be a case of their own."""
REALISTIC = SimSettings()
"""The simulation's defaults: uneven light and blur, distortion, print errors, bow."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A site as built; `T_CS_WS` of a frame is where its board is."""

    site: Site
    settings: SimSettings
    geometry: TrueGeometry
    lens: Lens
    """The sub-camera's true lens."""
    board: Board
    """The board as drawn."""
    corners_mm: FloatArray
    """(corners, 3) the board as printed."""

    @classmethod
    def build(cls, site: Site, settings: SimSettings) -> Scene:
        """Build the rig of these settings; a board as drawn is turned a little."""
        geometry = build_geometry(site, settings)
        if settings.as_built.scale == 0.0:
            turn, middle = Pose.from_vectors(np.radians(MOUNTED_DEG), np.zeros(3)), np.zeros(3)
            middle[:2] = geometry.board.size_mm / 2.0
            T_CS_WS = geometry.T_CS_WS
            turned = turn.R @ T_CS_WS.R
            t_mm = T_CS_WS.apply(middle[None])[0] - turned @ middle
            geometry = replace(geometry, T_CS_WS=Pose(turned, t_mm))
        true = geometry.sub
        lens = np.array([true.fx_px, true.fy_px, 0.0, true.cx_px, true.cy_px, *true.distortion])
        corners_mm = geometry.board.corners_mm()[1:-1, 1:-1].reshape(-1, 3)
        board = Board.nominal(site.sub_target)
        return cls(site, settings, geometry, Lens(lens), board, corners_mm)

    @property
    def rig(self) -> Rig:
        """The true rig, for what a motion does at the main target."""
        depth_mm = float(self.geometry.T_CM_WM.t_mm[2])
        scale = self.geometry.main.fx_px / depth_mm
        return Rig(self.geometry.T_CM_CS, depth_mm, scale, self.site.main.centre_px)

    def poses(self, count: int, seed: int) -> list[Pose]:
        """`T_CS_WS` of frames that have drifted."""
        rng = np.random.default_rng(seed)
        reach = np.array([DRIFT_MRAD * 1e-3] * 3 + [DRIFT_MM] * 3)
        drifts = [rng.uniform(-reach, reach) for _ in range(count)]
        T_CS_WS = self.geometry.T_CS_WS
        return [Pose.from_vectors(d[:3], d[3:]).compose(T_CS_WS) for d in drifts]

    def false_mm(self, motion: Pose) -> FloatArray:
        """(2,) mm by which a rig motion seems to move the main target (u right, v down)."""
        middle = self.site.main.centre_px[None]
        return np.asarray((self.rig.move(middle, motion) - middle)[0] / self.rig.scale_px_per_mm)

    def false_by_pose(self, pose: Pose) -> FloatArray:
        """(2, 6) mm of false displacement by the perturbation of a pose `T_CS_WS`."""
        still = Pose.identity()
        by_motion = self.rig.move_jacobians(self.site.main.centre_px[None], still)[1][0]
        return np.asarray(by_motion @ motion_by_pose(still, pose) / self.rig.scale_px_per_mm)

    def sub_renderer(self, sensor: Sensor, wider_px: float = 0.0) -> CameraRenderer:
        """Make the sub-camera's renderer, its blur a little wider than set."""
        optics = self.settings.optics
        blur = optics.sub_blur_px + wider_px
        look = Look(blur, optics.corner_blur, optics.sub_shading, 2.0)
        return CameraRenderer(self.site.sub, self.geometry.sub, look, sensor)

    def main_renderer(self, sensor: Sensor) -> CameraRenderer:
        """Make the main camera's renderer."""
        optics = self.settings.optics
        look = Look(optics.main_blur_px, optics.corner_blur, optics.main_shading, 1.0)
        return CameraRenderer(self.site.main, self.geometry.main, look, sensor)

    def sub(self, renderer: CameraRenderer, T_CS_WS: Pose, seed: int = 0) -> GreyImage:
        """Render the board."""
        optics = self.settings.optics
        radiance = renderer.board(T_CS_WS, self.geometry.board, optics.sub_white, optics.sub_black)
        return self._expose(renderer, radiance, seed)

    def main(self, renderer: CameraRenderer, moved_mm: FloatArray, seed: int = 0) -> GreyImage:
        """Render the main target, moved by (2,) mm in WM."""
        optics, target = self.settings.optics, self.site.main_target
        moved = Pose(np.eye(3), np.append(moved_mm, 0.0))
        discs = np.column_stack([target.centres_mm, target.diameters_mm / 2.0])
        margin = PLATE_MARGIN * float(target.diameters_mm.max())
        low, high = target.centres_mm.min(axis=0), target.centres_mm.max(axis=0)
        plate = np.concatenate([low - margin, high + margin])
        greys = np.array([optics.main_white, optics.main_black, optics.main_grey])
        radiance = renderer.discs(self.geometry.T_CM_WM.compose(moved), discs, plate, greys)
        return self._expose(renderer, radiance, seed)

    def _expose(self, renderer: CameraRenderer, radiance: FloatArray, seed: int) -> GreyImage:
        lit = renderer.lit(np.asarray(radiance, np.float32), 1.0)
        pixels = renderer.expose(lit, self.settings.optics.pedestal, np.random.default_rng(seed))
        return GreyImage(pixels, 8 if pixels.dtype == np.uint8 else 16)

    def variance_dn2(self, mean_dn: FloatArray) -> FloatArray:
        """Variance of grey values of 8 bits: shot and read noise, and rounding."""
        sensor, top = self.settings.sensor, 255.0
        share = np.maximum(mean_dn / top - self.settings.optics.pedestal, 0.0)
        read = sensor.read_noise_e / sensor.full_well_e
        return np.asarray((share / sensor.full_well_e + read**2) * top**2 + 1.0 / 12.0)


def mean_dn(image: GreyImage) -> FloatArray:
    """(pixels,) grey values of a clean image on the scale of 8 bits."""
    return image.pixels.astype(np.float64).ravel() * (255.0 / image.saturation_dn)


def noisy(scene: Scene) -> Sensor:
    """The scene's sensor, 8 bits."""
    return replace(scene.settings.sensor, bits=8, noise=True)
