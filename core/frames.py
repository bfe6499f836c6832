"""Greyscale images as the core takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.errors import ImageError, ImageSizeError
from core.site import CameraGeometry

PixelArray = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class GreyImage:
    """One greyscale image."""

    pixels: PixelArray
    """(height, width), uint8 or uint16, DN."""
    bits: int = 8
    """Significant bits; a saturated pixel is 2**bits - 1."""

    @property
    def saturation_dn(self) -> float:
        """The grey value of a saturated pixel."""
        return float(2**self.bits - 1)


def require_size(image: GreyImage, camera: CameraGeometry, what: str) -> None:
    """Raise ImageError unless an image is greyscale, ImageSizeError unless it fits the camera."""
    shape = image.pixels.shape
    if len(shape) != 2:
        msg = f"{what}: not a greyscale image (array of shape {shape})"
        raise ImageError(msg)
    if shape != (camera.height_px, camera.width_px):
        msg = (
            f"{what}: image is {shape[1]}x{shape[0]} px, the config says "
            f"{camera.width_px}x{camera.height_px}"
        )
        raise ImageSizeError(msg)
