"""Greyscale images as the core takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import ImageError, ImageSizeError
from core.site import CameraGeometry

_FULL_16 = float(2**16 - 1)
"""Saturated grey value of 16 bits, DN."""

_BLACK, _WHITE = 0.06, 0.98
"""Of full scale. Where nothing is brighter than the first, there is no contrast to find a target
by; what is brighter than the second is as good as saturated. Chosen."""
_MOST_WHITE = 0.5
"""Share of the pixels: the white squares of a board are no more. Chosen."""
_HOT_PX = 3
"""A pixel that is bright alone in a square of this side is hot; it is not light."""

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


def mean_image(images: Sequence[GreyImage]) -> GreyImage:
    """Average images of a scene at rest pixel by pixel, to 16 bits.

    A pixel that is saturated in one image is saturated in the mean: its true value is not known.
    Raises ImageError for images of different size or depth.

    >>> pixels = np.array([[100, 255]], dtype=np.uint8)
    >>> mean = mean_image([GreyImage(pixels), GreyImage(pixels + np.array([[1, 0]], np.uint8))])
    >>> (mean.pixels / mean.saturation_dn * 255.0).round(2).tolist()
    [[100.5, 255.0]]
    """
    shapes = {(image.pixels.shape, image.bits) for image in images}
    if len(shapes) != 1:
        msg = f"{len(images)} images of {len(shapes)} sizes or depths cannot be averaged"
        raise ImageError(msg)
    full = images[0].saturation_dn
    total = np.zeros(images[0].pixels.shape)
    saturated = np.zeros(images[0].pixels.shape, dtype=bool)
    for image in images:
        total += image.pixels
        saturated |= image.pixels >= full
    mean = np.rint(total * (_FULL_16 / (full * len(images))))
    mean = np.where(saturated, _FULL_16, np.minimum(mean, _FULL_16 - 1.0))
    return GreyImage(mean.astype(np.uint16), 16)


def require_size(image: GreyImage, camera: CameraGeometry, what: str) -> None:
    """Raise ImageError unless an image is greyscale, ImageSizeError unless it fits the camera."""
    shape = image.pixels.shape
    if len(shape) != 2:
        msg = f"{what}: not a greyscale image (array of shape {shape})"
        raise ImageError(msg)
    if shape != (camera.height_px, camera.width_px):
        swapped = shape == (camera.width_px, camera.height_px)
        cure = "they look swapped, exchange" if swapped else "correct"
        msg = (
            f"{what}: image is {shape[1]}x{shape[0]} px, the config says "
            f"{camera.width_px}x{camera.height_px}; {cure} width_px and height_px of its camera"
            f"{'' if swapped else ', or use the images of that camera'}"
        )
        raise ImageSizeError(msg)


def light_fault(image: GreyImage, exposure: str = "exposure time") -> str | None:
    """Say that an image is black or overexposed, and what to do; None where it is neither.

    exposure is what to change, as the user calls it.

    >>> light_fault(GreyImage(np.full((20, 30), 3, np.uint8))).split(";")[0]
    'the image is black, its brightest pixel at 1.2 % of full scale'
    >>> light_fault(GreyImage(np.full((20, 30), 255, np.uint8))).split(";")[0]
    'the image is overexposed, 100 % of its pixels saturated'
    """
    full = image.saturation_dn
    brightest = float(cv2.medianBlur(image.pixels, _HOT_PX).max()) / full
    if brightest < _BLACK:
        return (
            f"the image is black, its brightest pixel at {100.0 * brightest:.1f} % of full scale; "
            f"take the cap off the lens, light the target, or set a longer {exposure}"
        )
    white = float((image.pixels >= _WHITE * full).mean())
    if white > _MOST_WHITE:
        return (
            f"the image is overexposed, {100.0 * white:.0f} % of its pixels saturated; less "
            f"light, or a shorter {exposure}"
        )
    return None
