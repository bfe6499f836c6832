"""From a true pose to grey values: what one camera's lens and sensor make of a flat scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from core.pose import Pose
from core.site import CameraGeometry, FloatArray
from drivers.protocols import Image
from drivers.sim import kernels
from drivers.sim.geometry import TrueBoard, TrueLens
from drivers.sim.kernels import Float32Array
from drivers.sim.settings import Sensor

MARGIN_PX = 4
"""Rendered beyond each border, so that blur brings in what a real lens would."""


@dataclass(frozen=True, slots=True)
class Look:
    """Blur and shading of one camera."""

    blur_px: float
    """Gaussian sigma of the lens in the image centre."""
    corner_blur: float
    """Sigma in the corner over sigma in the centre."""
    shading: float
    """Light lost between the brightest and the darkest point."""
    uphill_rad: float
    """Direction in which the light grows."""


class CameraRenderer:
    """One camera's lens and sensor; all that does not change is computed once."""

    def __init__(self, camera: CameraGeometry, lens: TrueLens, look: Look, sensor: Sensor) -> None:
        width, height = camera.width_px + 2 * MARGIN_PX, camera.height_px + 2 * MARGIN_PX
        self._sensor = sensor
        self._pattern = kernels.sample_pattern()
        self._shape = (height, width)
        self._rays = kernels.undistorted_rays(
            width,
            height,
            lens.fx_px,
            lens.fy_px,
            lens.cx_px + MARGIN_PX,
            lens.cy_px + MARGIN_PX,
            np.ascontiguousarray(lens.distortion),
        )
        self._near = _extra_sigma_px(look.blur_px)
        self._far = _extra_sigma_px(look.blur_px * look.corner_blur)
        x = (np.arange(width) - 0.5 * (width - 1)) / (0.5 * math.hypot(width, height))
        y = (np.arange(height) - 0.5 * (height - 1)) / (0.5 * math.hypot(width, height))
        radius2 = y[:, None] ** 2 + x**2
        slope = y[:, None] * math.sin(look.uphill_rad) + x * math.cos(look.uphill_rad)
        self._corner_weight = radius2.astype(np.float32)
        light = 1.0 - look.shading * (0.7 * radius2 + 0.15 * (1.0 - slope))
        self._light = light.astype(np.float32)

    def board(self, T_CS_WS: Pose, board: TrueBoard, white: float, black: float) -> Float32Array:
        """Reflectance of a board, with margins, before the lens."""
        out = np.empty(self._shape, np.float32)
        inverse = T_CS_WS.inverse()
        half = board.size_mm / 2.0
        first = np.array([board.x_lines_mm[0], board.y_lines_mm[0]])
        kernels.render_board(
            self._rays,
            np.ascontiguousarray(inverse.R),
            inverse.t_mm,
            np.concatenate([[board.bow_mm], first + half, half]),
            np.concatenate([[-np.inf], board.x_lines_mm, [np.inf]]),
            np.concatenate([[-np.inf], board.y_lines_mm, [np.inf]]),
            self._pattern,
            white,
            black,
            out,
        )
        return out

    def discs(
        self, T_CM_WM: Pose, discs_mm: FloatArray, plate_mm: FloatArray, greys: FloatArray
    ) -> Float32Array:
        """Reflectance of discs (n, 3: x, y, radius) on a plate, with margins, before the lens."""
        out = np.empty(self._shape, np.float32)
        inverse = T_CM_WM.inverse()
        R = np.ascontiguousarray(inverse.R)
        kernels.render_discs(
            self._rays, R, inverse.t_mm, discs_mm, plate_mm, self._pattern, greys, out
        )
        return out

    def lit(self, reflectance: Float32Array, light: float) -> Float32Array:
        """Light falls on the scene, more of it here than there."""
        reflectance *= self._light * np.float32(light)
        return reflectance

    def expose(self, radiance: Float32Array, pedestal: float, rng: np.random.Generator) -> Image:
        """Blur by the lens, count electrons, add noise, quantise: (height, width) DN.

        The blur is a mix of the centre's and the corner's Gaussian, such that the variance grows
        with the square of the distance from the centre.
        """
        near = _blurred(radiance, self._near)
        image = near + self._corner_weight * (_blurred(radiance, self._far) - near)
        image = image[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        sensor = self._sensor
        top = float(2**sensor.bits - 1)
        if sensor.noise:
            electrons = np.maximum(image, 0.0) * np.float32(sensor.full_well_e)
            sigma = np.sqrt(electrons + np.float32(sensor.read_noise_e**2))
            noise = rng.standard_normal(image.shape, np.float32)
            image = image + sigma * noise * np.float32(1.0 / sensor.full_well_e)
        dn = np.clip(np.rint((image + np.float32(pedestal)) * np.float32(top)), 0.0, top)
        return np.asarray(dn, np.uint8) if sensor.bits == 8 else np.asarray(dn, np.uint16)


def _extra_sigma_px(sigma_px: float) -> float:
    """Blur still to be added to what the sampling pattern holds already."""
    return math.sqrt(max(sigma_px**2 - kernels.PATTERN_SIGMA_PX**2, 0.0))


def _blurred(image: Float32Array, sigma_px: float) -> Float32Array:
    if sigma_px == 0.0:
        return image
    size = 2 * math.ceil(4.0 * sigma_px) + 1
    blurred = cv2.GaussianBlur(image, (size, size), sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float32)
