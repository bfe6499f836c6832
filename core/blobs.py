"""Candidates for discs: bright, round, sharply bounded regions at any threshold."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from core.site import BoolArray, FloatArray, IntArray

_LEVELS = 14
_MIN_RADIUS_PX = 3.0
_SEARCH_RADIUS_PX = 7.0
_LARGE_PX = 1000


@dataclass(frozen=True, slots=True)
class Blobs:
    """Bright round regions."""

    points_px: FloatArray
    """(n, 2) centres."""
    outline_px: FloatArray
    """(n, 2, 2) symmetric matrix taking the unit circle to the outline."""
    contrast_dn: FloatArray
    """(n,) inside minus outside."""

    @property
    def radius_px(self) -> FloatArray:
        """(n,) mean radius."""
        return np.asarray(np.trace(self.outline_px, axis1=1, axis2=2) / 2.0)

    def select(self, which: BoolArray | IntArray) -> Blobs:
        """Give some of them."""
        return Blobs(self.points_px[which], self.outline_px[which], self.contrast_dn[which])

    def strongest(self, most: int) -> Blobs:
        """Give those of the highest contrast, at most so many."""
        return self.select(np.sort(np.argsort(-self.contrast_dn)[:most]))


def find_blobs(
    grey: FloatArray, min_radius_px: float | None = None, min_contrast_dn: float = 4.0
) -> Blobs:
    """Find bright ellipses in a greyscale image (h, w), of axis ratio up to 2.

    Connected regions at several thresholds spread over the grey values; a region counts if its
    area agrees with its outline's ellipse and it is brighter than its surroundings. Of
    concentric regions the one with the sharpest edge stays. The image is searched at the size
    at which the smallest radius asked for is seven pixels; without one, large images at half.
    """
    shrink = 0.5 if max(grey.shape) > _LARGE_PX else 1.0
    if min_radius_px is not None:
        shrink = float(np.clip(_SEARCH_RADIUS_PX / min_radius_px, 0.2, 1.0))
    small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), dtype=np.float32)
    slope = cv2.magnitude(
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125),
    )
    gradient = np.asarray(slope, dtype=np.float32)
    found: list[tuple[float, ...]] = []
    for level in _levels(smooth):
        found.extend(_round_regions(smooth, gradient, level))
    return _bright_ones(smooth, _best_of_concentric(found), min_contrast_dn, shrink)


def _levels(smooth: FloatArray) -> FloatArray:
    low, high = np.percentile(smooth[::4, ::4], [0.5, 99.8])
    return np.asarray(low + (high - low) * np.linspace(0.08, 0.92, _LEVELS))


def _round_regions(
    smooth: FloatArray, gradient: FloatArray, level: float
) -> list[tuple[float, ...]]:
    """(x, y, a, b, angle_deg, sharpness) of the round regions above a level."""
    mask = (smooth > level).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    height, width = smooth.shape
    regions: list[tuple[float, ...]] = []
    for contour in contours:
        if len(contour) < 12 or len(contour) > 2 * (width + height):
            continue
        area = cv2.contourArea(contour)
        _, _, w, h = cv2.boundingRect(contour)
        if not 0.6 < area / (0.25 * np.pi * w * h) < 1.5 or max(w, h) > 0.5 * width:
            continue
        (cx, cy), (d1, d2), angle = cv2.fitEllipse(contour)
        a, b = d1 / 2.0 + 0.25, d2 / 2.0 + 0.25
        if min(a, b) < _MIN_RADIUS_PX or max(a, b) > 2.0 * min(a, b):
            continue
        if not 0.85 < (area + 0.5 * len(contour)) / (np.pi * a * b) < 1.15:
            continue
        edge = np.asarray(contour[:, 0], dtype=np.int64)
        if _fills_ellipse(edge, cx, cy, a, b, angle):
            sharpness = float(np.median(gradient[edge[:, 1], edge[:, 0]]))
            regions.append((cx, cy, a, b, angle, sharpness))
    return regions


def _ellipse(a: float, b: float, angle: float) -> FloatArray:
    """(32, 2) offsets of points on an ellipse from its centre."""
    t = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    x, y = a * np.cos(t), b * np.sin(t)
    return np.stack([c * x - s * y, s * x + c * y], axis=1)


def _contrast(smooth: FloatArray, cx: float, cy: float, a: float, b: float, angle: float) -> float:
    """Grey values just inside minus just outside; not positive if any part is reversed."""
    ring = _ellipse(a, b, angle)
    values = []
    for factor, extra in ((0.75, 0.0), (1.15, 1.5)):
        scaled = ring * factor + extra * ring / np.hypot(ring[:, :1], ring[:, 1:])
        u = np.clip(np.rint(cx + scaled[:, 0]).astype(int), 0, smooth.shape[1] - 1)
        v = np.clip(np.rint(cy + scaled[:, 1]).astype(int), 0, smooth.shape[0] - 1)
        values.append(smooth[v, u])
    inside, outside = values
    if np.percentile(inside - outside, 20) <= 0:
        return 0.0
    return float(np.median(inside) - np.median(outside))


def _fills_ellipse(edge: IntArray, cx: float, cy: float, a: float, b: float, angle: float) -> bool:
    """Whether most of the contour lies on the ellipse."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    dx, dy = edge[:, 0] - cx, edge[:, 1] - cy
    rho = np.hypot((c * dx + s * dy) / a, (c * dy - s * dx) / b)
    return bool(np.mean(np.abs(rho - 1.0) < 1.2 / min(a, b) + 0.05) > 0.8)


def _best_of_concentric(found: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Keep the sharpest of the regions that share a centre."""
    regions = np.array(sorted(found, key=lambda region: -region[5])).reshape(-1, 6)
    left = np.ones(len(regions), dtype=bool)
    kept = []
    for k, region in enumerate(regions):
        if left[k]:
            away = np.hypot(regions[:, 0] - region[0], regions[:, 1] - region[1])
            left &= away > 0.5 * max(region[2:4].min(), 3.0)
            kept.append(tuple(region.tolist()))
    return kept


def _bright_ones(
    smooth: FloatArray, found: list[tuple[float, ...]], min_contrast_dn: float, shrink: float
) -> Blobs:
    """Those brighter than their surroundings, at the full image's size."""
    contrasts = np.array([_contrast(smooth, *blob[:5]) for blob in found])
    bright = contrasts >= min_contrast_dn
    best = np.array(found).reshape(-1, 6)[bright]
    angle = np.radians(best[:, 4])
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = axes[:, :, None] * axes[:, None, :]
    outline = best[:, 2, None, None] * along + best[:, 3, None, None] * (np.eye(2) - along)
    return Blobs((best[:, :2] + 0.5) / shrink - 0.5, outline / shrink, contrasts[bright])
