"""What weather and animals do to an image; each draws on it in place, blurred as the scene is."""

from __future__ import annotations

import math

import cv2
import numpy as np

from core.arrays import FloatArray
from drivers.sim.kernels import Float32Array

SHIFT = 4
"""Fractional bits of OpenCV's drawing coordinates."""

SUBPIXELS = 16.0

BLUR_PX = 0.6
"""Gaussian sigma of what is drawn, about that of the lens in the image centre."""

INSECT_GREY = 0.03
SNOW_GREY = 0.8
COBWEB_GREY = 0.6
RAIN_GREY = 0.5


def draw_insect(
    image: Float32Array, at_px: FloatArray, length_px: float, rng: np.random.Generator
) -> None:
    """Put a dark oval body with six legs on the image (height, width), reflectance."""
    mask = np.zeros(image.shape, np.uint8)
    heading = rng.uniform(0.0, math.pi)
    along = np.array([math.cos(heading), math.sin(heading)])
    across = np.array([-along[1], along[0]])
    axes = (_fixed(0.5 * length_px), _fixed(0.22 * length_px))
    degrees = math.degrees(heading)
    cv2.ellipse(mask, _point(at_px), axes, degrees, 0, 360, 255, -1, cv2.LINE_AA, SHIFT)
    width = max(1, round(0.04 * length_px))
    for station in (-0.25, 0.0, 0.25):
        for side in (-1.0, 1.0):
            root = at_px + station * length_px * along
            bend = rng.uniform(-0.2, 0.2) + station
            foot = root + length_px * (0.42 * side * across + 0.6 * bend * along)
            cv2.line(mask, _point(root), _point(foot), 255, width, cv2.LINE_AA, SHIFT)
    _cover(image, mask, INSECT_GREY)


def draw_snow(image: Float32Array, rng: np.random.Generator) -> None:
    """Let flakes of all sizes fall before a veiled scene of lower contrast."""
    image *= 0.75
    image += 0.08
    height, width = image.shape
    mask = np.zeros(image.shape, np.uint8)
    for _ in range(120):
        at_px = rng.uniform(0.0, 1.0, 2) * (width, height)
        radius_px = width / 1920.0 * rng.lognormal(1.2, 0.5)
        axes = (_fixed(radius_px), _fixed(radius_px * rng.uniform(1.0, 3.0)))
        tilt = rng.uniform(-25.0, 25.0)
        strength = rng.integers(120, 255)
        cv2.ellipse(mask, _point(at_px), axes, tilt, 0, 360, int(strength), -1, cv2.LINE_AA, SHIFT)
    _cover(image, mask, SNOW_GREY)


def draw_rain(image: Float32Array, rng: np.random.Generator) -> None:
    """Let drops fall before a veiled scene: faint streaks, nearly upright."""
    image *= 0.85
    image += 0.05
    height, width = image.shape
    mask = np.zeros(image.shape, np.uint8)
    for _ in range(60):
        at_px = rng.uniform(0.0, 1.0, 2) * (width, height)
        fall_px = width * rng.uniform(0.02, 0.06) * np.array([rng.normal(0.0, 0.1), 1.0])
        strength = int(rng.integers(30, 90))
        cv2.line(mask, _point(at_px), _point(at_px + fall_px), strength, 1, cv2.LINE_AA, SHIFT)
    _cover(image, mask, RAIN_GREY)


def draw_glare(image: Float32Array, rng: np.random.Generator) -> None:
    """Add a bright patch of scattered light that saturates its middle."""
    height, width = image.shape
    middle = rng.uniform(0.2, 0.8, 2) * (width, height)
    across = np.exp(-0.5 * ((np.arange(width) - middle[0]) / (0.12 * width)) ** 2)
    down = np.exp(-0.5 * ((np.arange(height) - middle[1]) / (0.12 * width)) ** 2)
    image += (0.9 * np.outer(down, across)).astype(np.float32)


def draw_cobweb(image: Float32Array, rng: np.random.Generator) -> None:
    """Hang a web of fine bright threads before the middle of the image."""
    height, width = image.shape
    mask = np.zeros(image.shape, np.uint8)
    middle = np.array([width, height]) * rng.uniform(0.3, 0.7, 2)
    spokes = np.sort(rng.uniform(0.0, math.tau, 14))
    directions = np.stack([np.cos(spokes), np.sin(spokes)], axis=1)
    for direction in directions:
        far = middle + 0.45 * width * direction
        cv2.line(mask, _point(middle), _point(far), 200, 1, cv2.LINE_AA, SHIFT)
    for radius in np.linspace(0.04, 0.4, 10) * width:
        ring = [_point(middle + radius * direction) for direction in directions]
        cv2.polylines(
            mask, [np.array(ring)], isClosed=True, color=200, lineType=cv2.LINE_AA, shift=SHIFT
        )
    _cover(image, mask, COBWEB_GREY)


def draw_cover(image: Float32Array, rng: np.random.Generator) -> None:
    """Let a sheet hang over one side of the image, up to the middle of it."""
    height, width = image.shape
    share, slant = rng.uniform(0.15, 0.5), rng.uniform(-0.1, 0.1)
    edge = np.array([[0.0, 0.0], [share + slant, 0.0], [share - slant, 1.0], [0.0, 1.0]])
    side = rng.integers(4)
    corners = 1.0 - edge if side >= 2 else edge
    corners = corners[:, ::-1] if side % 2 else corners
    mask = np.zeros(image.shape, np.uint8)
    sheet = np.array([_point(corner * (width, height)) for corner in corners])
    cv2.fillPoly(mask, [sheet], 255, cv2.LINE_AA, SHIFT)
    _cover(image, mask, rng.uniform(0.05, 0.7))


def haze_mm(discs: int, sigma_mm: float, rng: np.random.Generator) -> FloatArray:
    """How far hot air moves each disc's image (discs, 2), at the target: most of it together."""
    together = rng.normal(0.0, sigma_mm, 2)
    return np.asarray(together + rng.normal(0.0, sigma_mm / 3.0, (discs, 2)))


def _cover(image: Float32Array, mask: np.ndarray, grey: float) -> None:
    soft = cv2.GaussianBlur(mask, (5, 5), BLUR_PX)
    opacity = soft.astype(np.float32) / np.float32(255.0)
    image += opacity * (np.float32(grey) - image)


def _fixed(value: float) -> int:
    return round(value * SUBPIXELS)


def _point(at_px: FloatArray) -> tuple[int, int]:
    return _fixed(at_px[0]), _fixed(at_px[1])
