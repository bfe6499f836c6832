"""What can happen to an image between the target and the program."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from core.images import GreyImage

Damage = Callable[[GreyImage, np.random.Generator], GreyImage]


def _change(image: GreyImage, values: np.ndarray) -> GreyImage:
    dtype = image.pixels.dtype
    return GreyImage(np.clip(np.rint(values), 0, image.saturation_dn).astype(dtype), image.bits)


def _box(image: GreyImage, rng: np.random.Generator) -> tuple[slice, slice]:
    height, width = image.pixels.shape
    x, y = np.sort(rng.integers(0, width, 2)), np.sort(rng.integers(0, height, 2))
    return slice(y[0], y[1] + 1), slice(x[0], x[1] + 1)


def covered(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Something of one grey value covers a part."""
    values = image.pixels.astype(float)
    values[_box(image, rng)] = rng.uniform(0, image.saturation_dn)
    return _change(image, values)


def shaded(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """A sharp shadow falls on a part."""
    values = image.pixels.astype(float)
    values[_box(image, rng)] *= rng.uniform(0.1, 0.9)
    return _change(image, values)


def noisy(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Much more noise."""
    sigma = rng.uniform(1.0, 0.2 * image.saturation_dn)
    return _change(image, image.pixels + rng.normal(0.0, sigma, image.pixels.shape))


def blurred(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Out of focus, or moved while exposed."""
    size = 2 * rng.integers(0, 12, 2) + 1
    return _change(image, cv2.blur(image.pixels.astype(np.float32), (int(size[0]), int(size[1]))))


def dimmed(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Less or more light."""
    return _change(image, image.pixels * np.exp(rng.uniform(-4.0, 1.5)))


def spotted(image: GreyImage, rng: np.random.Generator) -> GreyImage:
    """Drops, flakes, lamps: round bright and dark spots."""
    values = image.pixels.astype(np.float32)
    height, width = values.shape
    for _ in range(int(rng.integers(1, 60))):
        at = int(rng.integers(width)), int(rng.integers(height))
        grey = float(rng.uniform(0, image.saturation_dn))
        cv2.circle(values, at, int(rng.integers(1, 30)), grey, -1, cv2.LINE_AA)
    return _change(image, values)


DAMAGES: tuple[Damage, ...] = (
    covered,
    shaded,
    noisy,
    blurred,
    dimmed,
    spotted,
)
