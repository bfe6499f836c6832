"""Views that came mirrored or turned by 180 degrees: they fit the lens once they are turned back.

No lens has its principal point and its distortion's centre quite in the middle of the image, so
that its mirrored image is another lens's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.resection import BoardView, resect
from core.errors import TargetNotFoundError
from core.geometry.lens import Lens
from core.lens.lens_start import ImageSize, subsample

_CORNERS = 100
"""Of a view that are fitted."""
_CLEARLY_BETTER = 2.0
"""Ratio of residuals from which a view is said to be mirrored. Chosen: with simulated lenses it is
4 to 160; a lens that is mirrored as well as not leaves it at 1."""
MIRRORED = (
    "mirrored or turned by 180 degrees: it fits the other views once it is turned back; switch "
    "ReverseX and ReverseY of the sub-camera off, and take it again"
)


def looks_mirrored(
    view: BoardView, lens: Lens, board: Board, corners_mm: FloatArray, size: ImageSize
) -> bool:
    """Whether a view fits a lens clearly better mirrored, flipped or turned by 180 degrees.

    corners_mm (corners, 3): the board's, as far as its shape is known; size: the image's, px.
    """
    few = subsample(view, _CORNERS)
    try:
        off_px = resect(lens, corners_mm, few).median_rms_px
        turned = [resect(lens, corners_mm, v).median_rms_px for v in _turned(few, board, size)]
    except TargetNotFoundError:
        return False
    return off_px > _CLEARLY_BETTER * min(turned)


def _turned(view: BoardView, board: Board, size: ImageSize) -> Iterator[BoardView]:
    """The view in mirrored and turned images, with each name that its corners may have then."""
    j, i = np.divmod(view.index, board.columns)
    ends = np.array([board.columns, board.rows]) - 1
    ways = [np.stack([i, j], axis=1)]
    if board.columns == board.rows:  # it may have been taken for one that is turned by 90 degrees
        ways.append(np.stack([j, board.columns - 1 - i], axis=1))
    for flipped in ((True, False), (False, True), (True, True)):
        points = np.where(flipped, np.array(size) - 1.0 - view.points_px, view.points_px)
        mirrored = flipped[0] != flipped[1]  # and then the board is, too
        for ij in ways:
            for across in (True, False):
                named = np.where((across, across != mirrored), ends - ij, ij)
                index = board.index(named[:, 0], named[:, 1])
                yield replace(view, index=index, points_px=points)
