"""How bright a target is in an image: its white, its black, and how much of it is saturated.

By the target's own parts where it was found. Levels are those that a quarter of the white parts
exceed: an insect on some of them, or a spot of glare, is not what the camera is to be set by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray
from core.checkerboard.board import Board
from core.geometry.pose import Pose
from core.images import GreyImage
from core.results import Displacement, RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.site import CirclesTarget

_WHITE_PERCENTILE, _BLACK_PERCENTILE = 75.0, 50.0
"""Of the white and of the black parts: a quarter of the white ones exceed the level, see above."""
_AREA_WHITE, _AREA_BLACK = 95.0, 5.0
"""Of all pixels of an area; a seventh of the main target's is white."""
_INSIDE, _OUTSIDE = (0.0, 0.3, 0.6), (1.35,)
"""Radii at which a disc and the plate about it are looked at, in its own."""
_TURNS = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
"""Directions about a disc's centre in which it is looked at, rad."""
_LEAST_PARTS = 2
"""Of either colour: one alone may be covered."""

Box = tuple[int, int, int, int]
"""Part of an image, px: u0, v0, u1, v1; the last column and row are not in it."""


@dataclass(frozen=True, slots=True)
class TargetLight:
    """A target's light in one image; levels as shares of the grey values' range."""

    white: float
    black: float
    saturated: float
    """Share of its white parts, or of the area's pixels, that are saturated."""


def disc_light(image: GreyImage, points_px: FloatArray, radii_px: FloatArray) -> TargetLight | None:
    """Light of discs (n, 2) with radii (n,), px; None where fewer than two are in the image."""
    parts = []
    for rings in (_INSIDE, _OUTSIDE):
        steps = np.concatenate(
            [ring * np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1) for ring in rings]
        )
        parts.append(points_px[:, None] + radii_px[:, None, None] * steps)
    return _light(image, *parts)


def board_light(
    image: GreyImage, board: Board, index: IntArray, points_px: FloatArray
) -> TargetLight | None:
    """Light of the squares between the corners (n,) seen at points (n, 2), px.

    None where fewer than two squares of either colour have all their corners.
    """
    corners = np.full((board.rows * board.columns, 2), np.nan)
    corners[index] = points_px
    grid = corners.reshape(board.rows, board.columns, 2)
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
    j, i = np.indices(middles.shape[:2])
    black = ((i + j) % 2 == 0) & np.isfinite(middles).all(axis=2)
    white = ((i + j) % 2 == 1) & np.isfinite(middles).all(axis=2)
    around = np.array([(u, v) for u in (-1.0, 0.0, 1.0) for v in (-1.0, 0.0, 1.0)])
    return _light(image, middles[white][:, None] + around, middles[black][:, None] + around)


def area_light(image: GreyImage, box: Box) -> TargetLight:
    """Light of a part of an image in which the target should be.

    >>> pixels = np.where(np.arange(100) < 20, 204, 51).astype(np.uint8).reshape(10, 10)
    >>> area_light(GreyImage(pixels), (0, 0, 10, 10))
    TargetLight(white=0.8, black=0.2, saturated=0.0)
    """
    u0, v0, u1, v1 = box
    pixels = image.pixels[v0:v1, u0:u1]
    black, white = np.percentile(pixels, [_AREA_BLACK, _AREA_WHITE]) / image.saturation_dn
    return TargetLight(float(white), float(black), float((pixels >= image.saturation_dn).mean()))


def discs_in_image(
    target: CalibratedTarget, drawn: CirclesTarget, raw: Displacement
) -> tuple[FloatArray, FloatArray]:
    """Where a raw displacement says that a target's discs are: (n, 2) and radii (n,), px."""
    seen = np.isfinite(target.reference_px).all(axis=1)
    points = target.reference_px[seen] + target.B @ raw.mm
    scale = float(np.sqrt(abs(np.linalg.det(target.B))))
    return points, scale * drawn.diameters_mm[seen] / 2.0


def corners_in_image(calibrated: CalibratedSite, motion: RigMotion) -> tuple[IntArray, FloatArray]:
    """Where a rig motion says that the board's corners are: (n,) and (n, 2), px."""
    moved = Pose.from_vectors(motion.rotation_rad, motion.translation_mm)
    pose = moved.compose(calibrated.reference_pose)
    in_camera = pose.apply(calibrated.corners_mm)
    index = np.nonzero(calibrated.lens.sees(in_camera))[0]
    return index, calibrated.lens.project(in_camera[index])


def box_about(image: GreyImage, points_px: FloatArray, margin_px: float) -> Box:
    """Give the part of an image that holds points (n, 2) and a margin; all of it where none is."""
    height, width = image.pixels.shape
    low = np.clip(np.floor(points_px.min(axis=0) - margin_px), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(points_px.max(axis=0) + margin_px) + 1, 0, [width, height]).astype(int)
    if (high <= low).any():
        return 0, 0, width, height
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _light(image: GreyImage, white_px: FloatArray, black_px: FloatArray) -> TargetLight | None:
    """Light of parts (n, k, 2) and (m, k, 2), px, each by the median of its points."""
    white, black = _levels(image, white_px), _levels(image, black_px)
    if min(len(white), len(black)) < _LEAST_PARTS:
        return None
    full = image.saturation_dn
    return TargetLight(
        float(np.percentile(white, _WHITE_PERCENTILE)) / full,
        float(np.percentile(black, _BLACK_PERCENTILE)) / full,
        float((white >= full).mean()),
    )


def _levels(image: GreyImage, parts_px: FloatArray) -> FloatArray:
    """Grey value of each part (n, k, 2) that is wholly in the image."""
    height, width = image.pixels.shape
    at = np.rint(parts_px).astype(int)
    at = at[((at >= 0) & (at < [width, height])).all(axis=(1, 2))]
    return np.asarray(np.median(image.pixels[at[..., 1], at[..., 0]].astype(float), axis=1))
