"""How a printed board may differ from the nominal one: scale, shear, bow, lines, corners.

A printer puts each line in a place of its own, so an error of a line is common to all corners on
it; the rest is each corner's own error. Their sizes differ from print to print and are
estimated with the board (core.adjustment.bundle_adjustment).
"""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board

SHAPE_PARAMETERS = 13
"""Scale x, scale y, shear, then ten terms of bow."""


def shape_terms(board: Board) -> FloatArray:
    """d(corner)/d(shape) (corners, 3, 13): scale x, scale y, shear, then ten terms of bow.

    >>> terms = shape_terms(Board.of_squares(10, 7, 30.0))
    >>> terms[-1, 0, 0].item(), terms[-1, 2, 3].item()  # mm: of a scale of 2; a bow of 1 mm
    (120.0, 1.0)
    """
    flat = board.corners_mm
    centre = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    x, y = (flat - centre)[:, 0], (flat - centre)[:, 1]
    half = max(float(np.abs(x).max()), float(np.abs(y).max()))
    p, q = x / half, y / half
    terms = np.zeros((len(flat), 3, SHAPE_PARAMETERS))
    terms[:, 0, 0], terms[:, 1, 1] = x, y
    terms[:, 0, 2] = y
    bow = [p * p, p * q, q * q, p**3, p * p * q, p * q * q, q**3, p**4, p * p * q * q, q**4]
    terms[:, 2, 3:] = np.stack(bow, axis=1)
    return terms


def shape_sigmas(scale: float, bow_mm: tuple[float, float, float]) -> FloatArray:
    """(13,) 1-sigma priors: scale and shear, bow of second, third and fourth degree."""
    second, third, fourth = bow_mm
    return np.array([scale] * 3 + [second] * 3 + [third] * 4 + [fourth] * 3)


def line_terms(board: Board) -> FloatArray:
    """d(corner)/d(lines) (corners, 3, columns + rows): x of the columns, then y of the rows."""
    count = board.columns * board.rows
    j, i = np.divmod(np.arange(count), board.columns)
    terms = np.zeros((count, 3, board.columns + board.rows))
    terms[np.arange(count), 0, i] = 1.0
    terms[np.arange(count), 1, board.columns + j] = 1.0
    return terms


def board_terms(board: Board) -> FloatArray:
    """d(corner)/d(shape and lines) (corners, 3, 13 + columns + rows)."""
    return np.concatenate([shape_terms(board), line_terms(board)], axis=2)
