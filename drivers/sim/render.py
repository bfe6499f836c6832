"""From a true pose to grey values: what one camera's lens and sensor make of a flat scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ive

from core.arrays import FloatArray, IntArray
from core.geometry.pose import Pose
from core.site import CameraGeometry
from drivers.protocols import Image
from drivers.sim import kernels
from drivers.sim.geometry import TrueBoard, TrueLens
from drivers.sim.kernels import Float32Array
from drivers.sim.response import pixel_response
from drivers.sim.settings import Sensor

MARGIN_PX = 4
"""Rendered beyond each border, so that blur brings in what a real lens would."""


@dataclass(frozen=True, slots=True)
class Look:
    """Blur and shading of one camera."""

    blur_px: float
    """Gaussian sigma of the lens in the image centre."""
    corner_blur: float
    """Sigma in the corner over sigma in the centre, at least 1."""
    shading: float
    """Light lost between the brightest and the darkest point."""
    uphill_rad: float
    """Direction in which the light grows."""


@dataclass(frozen=True, slots=True)
class Exposed:
    """How a frame is exposed."""

    time: float = 1.0
    """In exposures for which the scene's grey values are given."""
    gain: float = 1.0
    """Of the amplifier between the sensor and its numbers: noise grows with it."""


ORDINARY = Exposed()


class CameraRenderer:
    """One camera's lens and sensor; all that does not change is computed once."""

    def __init__(self, camera: CameraGeometry, lens: TrueLens, look: Look, sensor: Sensor) -> None:
        width, height = camera.width_px + 2 * MARGIN_PX, camera.height_px + 2 * MARGIN_PX
        self._sensor = sensor
        self._lens = lens
        self._rays = self._rays_of(lens, width, height)
        self._response = pixel_response(look.blur_px)
        self._further = _discrete_gaussian(look.blur_px**2 * (look.corner_blur**2 - 1.0))
        self._shape = (height, width)
        x = (np.arange(width) - 0.5 * (width - 1)) / (0.5 * math.hypot(width, height))
        y = (np.arange(height) - 0.5 * (height - 1)) / (0.5 * math.hypot(width, height))
        radius2 = y[:, None] ** 2 + x**2
        slope = y[:, None] * math.sin(look.uphill_rad) + x * math.cos(look.uphill_rad)
        self._corner_weight = radius2.astype(np.float32)
        light = 1.0 - look.shading * (0.7 * radius2 + 0.15 * (1.0 - slope))
        self._light = light.astype(np.float32)

    def refocus(self, lens: TrueLens) -> None:
        """Look through this lens from now on; costs nothing if it is the same as before."""
        if lens is not self._lens:
            self._lens = lens
            self._rays = self._rays_of(lens, self._shape[1], self._shape[0])

    @staticmethod
    def _rays_of(lens: TrueLens, width: int, height: int) -> Float32Array:
        return kernels.undistorted_rays(
            width,
            height,
            lens.fx_px,
            lens.fy_px,
            lens.cx_px + MARGIN_PX,
            lens.cy_px + MARGIN_PX,
            np.ascontiguousarray(lens.distortion),
        )

    def board(self, T_CS_WS: Pose, board: TrueBoard, white: float, black: float) -> Float32Array:
        """Reflectance of a board, with margins, blurred as in the image centre."""
        half = board.size_mm / 2.0
        first = np.array([board.x_lines_mm[0], board.y_lines_mm[0]])
        sheet = np.concatenate([[board.bow_mm], first + half, half])
        return self._squares(T_CS_WS, sheet, board.x_lines_mm, board.y_lines_mm, white, black)

    def discs(
        self, T_CM_WM: Pose, discs_mm: FloatArray, plate_mm: FloatArray, greys: FloatArray
    ) -> Float32Array:
        """Reflectance of discs (n, 3: x, y, radius) on a plate, blurred as in the image centre.

        plate_mm: x0, y0, x1, y1. greys: disc, plate, background.
        """
        white, black, grey = greys
        out = self._squares(T_CM_WM, np.zeros(5), plate_mm[::2], plate_mm[1::2], grey, black)
        self._add_discs(T_CM_WM, discs_mm, white - black, out)
        return out

    def add_plate(
        self,
        scene: Float32Array,
        T_CM_W: Pose,
        discs_mm: FloatArray,
        plate_mm: FloatArray,
        greys: FloatArray,
    ) -> None:
        """Put one more plate of discs into a scene from `discs`, where only background is."""
        white, black, grey = greys
        x_mm, y_mm = plate_mm[::2], plate_mm[1::2]
        scene += self._squares(T_CM_W, np.zeros(5), x_mm, y_mm, 0.0, black - grey)
        self._add_discs(T_CM_W, discs_mm, white - black, scene)

    def _add_discs(
        self, T_CM_WM: Pose, discs_mm: FloatArray, contrast: float, out: Float32Array
    ) -> None:
        inverse = T_CM_WM.inverse()
        R, boxes = np.ascontiguousarray(inverse.R), self._boxes(T_CM_WM, discs_mm)
        kernels.add_discs(
            self._rays, R, inverse.t_mm, discs_mm, boxes, self._response, contrast, out
        )

    def _squares(
        self,
        T_camera_target: Pose,
        sheet: FloatArray,
        x_lines_mm: FloatArray,
        y_lines_mm: FloatArray,
        white: float,
        black: float,
    ) -> Float32Array:
        """Alternating squares between lines, the first one black, white around them."""
        out = np.empty(self._shape, np.float32)
        inverse = T_camera_target.inverse()
        kernels.render_board(
            self._rays,
            np.ascontiguousarray(inverse.R),
            inverse.t_mm,
            sheet,
            np.concatenate([[-np.inf], x_lines_mm, [np.inf]]),
            np.concatenate([[-np.inf], y_lines_mm, [np.inf]]),
            self._response,
            white,
            black,
            out,
        )
        return out

    def _boxes(self, T_CM_WM: Pose, discs_mm: FloatArray) -> IntArray:
        """Where discs are seen, margins counted: (n, 4) px, u0, v0, u1, v1."""
        turns = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
        circle = np.stack([np.cos(turns), np.sin(turns), np.zeros(32)], axis=1)
        centres = np.column_stack([discs_mm[:, :2], np.zeros(len(discs_mm))])
        outlines = centres[:, None] + discs_mm[:, 2, None, None] * circle
        seen = self._lens.project(T_CM_WM.apply(outlines.reshape(-1, 3))).reshape(-1, 32, 2)
        reach = self._response.reach_px * math.sqrt(2.0) + 1.0
        low = np.floor(seen.min(axis=1) + MARGIN_PX - reach)
        high = np.ceil(seen.max(axis=1) + MARGIN_PX + reach) + 1.0
        corners = np.array([self._shape[1], self._shape[0]])
        return np.concatenate([low, high], axis=1).clip(0, np.tile(corners, 2)).astype(np.int64)

    def lit(self, reflectance: Float32Array, light: float) -> Float32Array:
        """Light falls on the scene, more of it here than there."""
        reflectance *= self._light * np.float32(light)
        return reflectance

    def expose(
        self,
        radiance: Float32Array,
        pedestal: float,
        rng: np.random.Generator,
        exposed: Exposed = ORDINARY,
    ) -> Image:
        """Blur towards the corners, count electrons, add noise, quantise: (height, width) DN.

        Electrons beyond the full well are lost, whatever the gain.
        """
        image = self._blurred(radiance)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        sensor = self._sensor
        top = float(2**sensor.bits - 1)
        image *= np.float32(exposed.time)
        if sensor.noise:
            noise = rng.standard_normal(image.shape, np.float32)
            variance = np.maximum(image, 0.0) * np.float32(1.0 / sensor.full_well_e)
            variance += np.float32((sensor.read_noise_e / sensor.full_well_e) ** 2)
            noise *= np.sqrt(variance, out=variance)
            image += noise
        np.minimum(image, np.float32(1.0), out=image)
        image *= np.float32(exposed.gain)
        image += np.float32(pedestal)
        image *= np.float32(top)
        dn = np.clip(np.rint(image, out=image), 0.0, top, out=image)
        return np.asarray(dn, np.uint8) if sensor.bits == 8 else np.asarray(dn, np.uint16)

    def _blurred(self, near: Float32Array) -> Float32Array:
        """Mix the centre's and the corner's Gaussian: variance grows as the distance squared.

        Half the mix goes by where the light comes from, half by where it arrives: either alone
        would shift edges along the slope of the blur, by up to 0.0004 px.
        """
        weighted = self._corner_weight * near
        spread = self._spread(near)
        spread *= self._corner_weight
        spread += self._spread(weighted)
        spread *= np.float32(0.5)
        spread += near
        spread -= weighted
        return spread

    def _spread(self, image: Float32Array) -> Float32Array:
        taps = self._further
        spread = cv2.sepFilter2D(image, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(spread, np.float32)


def _discrete_gaussian(variance_px2: float) -> FloatArray:
    """Filter that adds just this variance, however small: the Gaussian of whole numbers."""
    half = math.ceil(4.0 * math.sqrt(variance_px2)) + 1
    taps = ive(np.arange(-half, half + 1), variance_px2)
    return np.asarray(taps / taps.sum())
