"""Images without a target that cost a search much: full of what looks a little like one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def noise(shape: tuple[int, int]) -> Image:
    """Every pixel of any grey."""
    return np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8)


def fine_grid(shape: tuple[int, int]) -> Image:
    """Lines at a period of 4 px both ways."""
    v, u = np.indices(shape)
    return np.where((u % 4 == 0) | (v % 4 == 0), 220, 30).astype(np.uint8)


def foliage(shape: tuple[int, int]) -> Image:
    """Ellipses of any grey, one over the other, those of each size as dense as of any."""
    rng, image = np.random.default_rng(1), np.full(shape, 90, np.uint8)
    radius = 60.0
    while radius >= 3.5:
        for _ in range(int(image.size / (np.pi * radius**2))):
            at = int(rng.integers(shape[1])), int(rng.integers(shape[0]))
            axes = [max(1, int(radius * share)) for share in rng.uniform(0.3, 1.2, 2)]
            turn_deg, grey = float(rng.uniform(0, 180)), int(rng.integers(20, 235))
            cv2.ellipse(image, at, axes, turn_deg, 0, 360, grey, -1, cv2.LINE_AA)
        radius /= 1.6
    return image


def snow(shape: tuple[int, int]) -> Image:
    """White discs, 2 to 12 px wide, one for 400 px."""
    rng, image = np.random.default_rng(2), np.full(shape, 110, np.uint8)
    for _ in range(image.size // 400):
        at = [int(16 * rng.uniform(0, size)) for size in shape[::-1]]
        cv2.circle(image, at, int(16 * rng.uniform(1.0, 6.0)), 240, -1, cv2.LINE_AA, 4)
    return image


def black(shape: tuple[int, int]) -> Image:
    """Nothing at all."""
    return np.zeros(shape, np.uint8)


HARD_IMAGES = {
    "noise": noise,
    "fine grid": fine_grid,
    "foliage": foliage,
    "snow": snow,
    "black": black,
}
