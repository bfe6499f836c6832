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
    def of_squares(cls, squares_x: int, squares_y: int, square_mm: float) -> Board:
        """Build a perfect board from its number of squares each way and their side.

        >>> board = Board.of_squares(10, 7, 30.0)
        >>> board.columns, board.rows, board.corners_mm.shape
        (9, 6, (54, 3))
        >>> board.corners_mm[board.index(i=2, j=1)].tolist()
        [90.0, 60.0, 0.0]
        """
        columns, rows = squares_x - 1, squares_y - 1
        j, i = np.divmod(np.arange(columns * rows), columns)
        flat = np.stack([(i + 1) * square_mm, (j + 1) * square_mm, 0.0 * i], axis=1)
        return cls(columns, rows, square_mm, flat)

    @classmethod
    def nominal(cls, target: CheckerboardTarget) -> Board:
        """Build the board of a site as drawn."""
        return cls.of_squares(target.squares_x, target.squares_y, target.square_mm)

    def index(self, i: IntArray, j: IntArray) -> IntArray:
        """Index of corners by column and row."""
        return j * self.columns + i
