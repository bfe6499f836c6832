"""The pose of a board in one image, when the lens is known."""

from __future__ import annotations

from dataclasses import dataclass

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board, refine_board
from core.checkerboard.resection import BoardPose, BoardView, resect
from core.errors import TargetNotFoundError
from core.geometry.lens import Lens
from core.images import GreyImage


@dataclass(frozen=True, slots=True)
class SeenBoard:
    """A board in an image."""

    view: BoardView
    """Its corners, located."""
    fit: BoardPose
    """Its pose `T_CS_WS`, with the covariance that follows from the image's noise."""


def board_pose(
    image: GreyImage, lens: Lens, board: Board, corners_mm: FloatArray | None = None
) -> SeenBoard:
    """Find a board and fit its pose; a part of it may be outside the image or hidden.

    corners_mm (m, 3) is the board as calibrated (`LensCalibration.adjustment.corners_mm`); without
    it the board is taken as drawn. Raises TargetNotFoundError, also where the border of the
    board and the colour of its squares leave open which of its corners are seen. Source: Eq. 11
    of Lee et al. (2020), robust, over corners fitted to the grey values (docs/method.md).

    >>> import cv2, numpy as np
    >>> from core import LensModel
    >>> squares = np.pad(np.indices((7, 10)).sum(axis=0) % 2, 1, constant_values=1) * 200
    >>> print_px = np.kron(squares, np.ones((60, 60))).astype(np.uint8)  # 2 px/mm, a white margin
    >>> lens = Lens.ideal(LensModel.RADIAL, 700.0, (319.5, 239.5))
    >>> to_mm = np.array([[0.5, 0.0, -29.75], [0.0, 0.5, -29.75], [0.0, 0.0, 1.0]])
    >>> plane = np.array([[1.0, 0.0, -150.0], [0.0, 1.0, -105.0], [0.0, 0.0, 420.0]])  # [r1 r2 t]
    >>> image = cv2.warpPerspective(print_px, lens.matrix @ plane @ to_mm, (640, 480))
    >>> seen = board_pose(GreyImage(image), lens, Board.of_squares(10, 7, 30.0))
    >>> seen.fit.pose.t_mm.round(1).tolist(), len(seen.view.index)
    ([-150.0, -105.0, 420.0], 54)
    """
    corners_mm = board.corners_mm if corners_mm is None else corners_mm
    found = detect_board(image, board)
    if not found.unambiguous:
        msg = (
            "board: which part of it is seen is not certain; let at least one border of the board "
            "into the image in each direction"
        )
        raise TargetNotFoundError(msg)
    near = resect(lens, corners_mm, found.view).pose
    located = refine_board(image, lens, near, board, corners_mm)
    return SeenBoard(located.view, resect(lens, corners_mm, located.view, near))
