"""The checkerboard on the pier: its inner corners, nominal and as estimated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray
from core.site import CheckerboardTarget


@dataclass(frozen=True, slots=True)
class Board:
    """Inner corners of a checkerboard in WS; corner (i, j) has the index j * columns + i.

    i counts to the right and j down from the outer corner that is the WS origin; corner (0, 0)
    is one square in from it. The square up and left of corner (i, j) is black when i + j is even.
    """

    columns: int
    rows: int
    square_mm: float
    corners_mm: FloatArray
    """(rows * columns, 3)."""

    @classmethod
    def nominal(cls, target: CheckerboardTarget) -> Board:
        """Build the board as drawn."""
        columns, rows = target.squares_x - 1, target.squares_y - 1
        j, i = np.divmod(np.arange(columns * rows), columns)
        flat = np.stack([(i + 1) * target.square_mm, (j + 1) * target.square_mm, 0.0 * i], axis=1)
        return cls(columns, rows, target.square_mm, flat)

    def index(self, i: IntArray, j: IntArray) -> IntArray:
        """Index of corners by column and row."""
        return j * self.columns + i
