"""Which views of the board a lens calibration still wants: where in the image, and tilted how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray
from core.geometry.pose import Pose
from core.site import CameraGeometry

COLUMNS, ROWS = 6, 6
"""Cells of the image in which corners are counted."""
ENOUGH_VIEWS = 12
"""As docs/method.md asks: fewer leave the focal length of a 6 mm lens to the prior."""
ENOUGH_COVERED = 0.9
"""Share of the image's cells in which corners have been seen."""
TILTED_DEG = 10.0
"""A view tilted by less says little of the focal length: what it foreshortens goes with the square
of the tilt."""
ENOUGH_TILTED = 2
"""Views tilted each of the four ways; without them focal length and distance go together."""

_PLACES_ACROSS = ("left", "middle", "right")
_PLACES_DOWN = ("top", "centre", "bottom")
_FROM_THE_MIDDLE = (4, 3, 5, 1, 7, 0, 2, 6, 8)
"""Ninths of the image, row by row, those near the middle first."""
_TILTS = ("the right", "the left", "the bottom", "the top")


@dataclass(frozen=True, slots=True)
class LensCoverage:
    """What the views taken so far cover."""

    cells: IntArray
    """(ROWS, COLUMNS) corners seen in each cell of the image."""
    tilted: tuple[int, int, int, int]
    """Views with the board's right, left, bottom and top side away from the camera."""
    views: int

    @property
    def covered(self) -> float:
        """Share of the cells with corners in them."""
        return float((self.cells > 0).mean())

    @property
    def suggestions(self) -> tuple[str, ...]:
        """What to show next, the most important first; empty when there is enough."""
        suggestions = [
            f"tilt the board, {side} away from the camera, by 15 to 30 degrees"
            for side, count in zip(_TILTS, self.tilted, strict=True)
            if count < ENOUGH_TILTED
        ]
        if self.covered < ENOUGH_COVERED:
            suggestions.append(f"bring the board to the {self._emptiest()} of the sub image")
        if not suggestions and self.views < ENOUGH_VIEWS:
            missing = ENOUGH_VIEWS - self.views
            suggestions.append(f"{missing} more view{'s' * (missing > 1)}, each another way")
        return tuple(suggestions)

    def _emptiest(self) -> str:
        """Name the ninth of the image with the most empty cells; of equals one near the middle."""
        empty = (self.cells == 0).reshape(3, ROWS // 3, 3, COLUMNS // 3).sum(axis=(1, 3)).ravel()
        place = max(_FROM_THE_MIDDLE, key=lambda ninth: int(empty[ninth]))
        return f"{_PLACES_DOWN[place // 3]} {_PLACES_ACROSS[place % 3]}"


def lens_coverage(
    points_px: Sequence[FloatArray], poses: Sequence[Pose], camera: CameraGeometry
) -> LensCoverage:
    """Sum up the views of a board: corners (n, 2) px and a rough pose `T_CS_WS` of each.

    >>> camera = CameraGeometry(600, 600, 5.86, 6.0)
    >>> everywhere = 50.0 + 100.0 * np.indices((6, 6)).reshape(2, -1).T
    >>> square_on = lens_coverage([everywhere], [Pose.identity()], camera)
    >>> square_on.covered, square_on.suggestions[0]
    (1.0, 'tilt the board, the right away from the camera, by 15 to 30 degrees')
    """
    cells = np.zeros((ROWS, COLUMNS), dtype=np.int64)
    for points in points_px:
        column = np.clip(points[:, 0] / camera.width_px * COLUMNS, 0, COLUMNS - 1).astype(int)
        row = np.clip(points[:, 1] / camera.height_px * ROWS, 0, ROWS - 1).astype(int)
        np.add.at(cells, (row, column), 1)
    # R[2, 0] is how fast the board recedes along its x axis, R[2, 1] along its y axis.
    away = np.degrees(np.arcsin([[pose.R[2, 0], pose.R[2, 1]] for pose in poses])).reshape(-1, 2)
    right, left = (away[:, 0] > TILTED_DEG).sum(), (away[:, 0] < -TILTED_DEG).sum()
    bottom, top = (away[:, 1] > TILTED_DEG).sum(), (away[:, 1] < -TILTED_DEG).sum()
    return LensCoverage(cells, (int(right), int(left), int(bottom), int(top)), len(poses))
