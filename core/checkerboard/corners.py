"""The board's corners in an image: found without a guess, or refined from a predicted pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.checkerboard.board import Board
from core.checkerboard.corner_fit import CORNER_REACH_SQUARES, CornerFits, locate_corners, shrink
from core.checkerboard.lattice import (
    BLIND_PX,
    Fewer,
    IndexedLattice,
    Lattice,
    build_lattice,
    index_by_borders,
    index_near,
)
from core.checkerboard.map_kernels import TERMS, fit_maps
from core.checkerboard.resection import MIN_CORNERS, BoardView, resect, visible_corners
from core.checkerboard.saddle_points import find_saddle_points
from core.checkerboard.spurious_lines import without_spurious_lines
from core.errors import TargetNotFoundError
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.grey_fit import as_float
from core.images import GreyImage

_FIRST_REACH_PX, _FIRST_REACH_SQUARES = 7.0, 0.3
"""Small at first: without the lens, the edges are only straight near the corner."""
_STENCIL_SQUARES = 0.5
"""Spacing of the 3 x 3 board points whose images give a corner's map. Insensitive."""
CLEARLY_BETTER = 1.5
"""Ratio of residuals from which one place on the board is preferred to another. Lines printed 5 um
off are 0.1 px at 20 px/mm, ten times the noise of a corner; by chance the ratio of two medians over
some hundred corners stays within a few per cent of 1."""
_ROUGH_SIGMA_PX = 0.05
"""1 sigma of a corner before its fit: a saddle point's refinement by a parabola."""
_ROUGH_MISFIT_SQUARES = 0.1
"""A lattice whose corners miss the board by more, by the median, is not the board's.
Insensitive."""
_ROUGHLY = 1e-6
"""A step of the rough pose that is the last, rad and mm: 0.0001 px. Insensitive."""
_LEAST_SQUARE_PX = 9.0
"""Squares that are larger than this in a smaller image are found in it."""
_MOST = 0.9
"""Of the corners wanted: a smaller image that shows so many is enough. Insensitive."""
_BLIND_SHRUNK_PX = 9.0
"""So near to the edge of a shrunk image, in its own px, no corner is found."""
_MOST_NOISE, _LEAST_CONTRAST, _LEAST_SNR = 3.0, 0.3, 3.0
"""A corner is odd with so many times the median noise, less than this share of the median contrast,
or a contrast below so many times its own noise. Chosen: an insect, a drop or print dust is
beyond."""
_MOST_BLUR_PX = 5.9
"""A blur at the limit of the fit (6 px) is no blur: the corner is covered."""


@dataclass(frozen=True, slots=True)
class LocatedBoard:
    """What an image shows of the board."""

    view: BoardView
    unambiguous: bool
    """False if the corners could also be others of the board (only part of it was seen)."""
    white_dn: FloatArray
    """(m,) grey of the white squares about each of the view's corners."""
    black_dn: FloatArray
    """(m,) and of the black ones."""
    missing_px: FloatArray
    """(k, 2) about where corners should be that are not clear enough."""
    noise_dn: float
    contrast_dn: float
    blur_px: float
    near: Pose | None = None
    """Where the board is, to a tenth of a pixel; None where no lens was known."""
    quarter_turns: int = 0
    """By how many quarter turns it is turned in the image; known where no pose was."""
    fewer: Fewer = None
    """Known where no pose was."""

    @property
    def visible(self) -> int:
        """Corners that should be in the image."""
        return len(self.view.index) + len(self.missing_px)


def detect_board(image: GreyImage, board: Board) -> LocatedBoard:
    """Find the board without a guess and without a lens; it may be partly outside the image.

    Raises TargetNotFoundError.

    >>> squares = 200 * (np.indices((7, 10)).sum(axis=0) % 2)  # the first one is black
    >>> pixels = np.kron(np.pad(squares, 1, constant_values=200), np.ones((30, 30)))
    >>> pixels = pixels.astype(np.uint8)
    >>> found = detect_board(GreyImage(pixels), Board.of_squares(10, 7, 30.0))
    >>> len(found.view.index), found.unambiguous, found.view.points_px[0].round(2).tolist()
    (54, True, [59.5, 59.5])
    """
    height, width = image.pixels.shape
    indexed = index_by_borders(_lattice(image), board, width, height)
    maps = np.zeros((len(indexed.index), 2, 5))
    maps[:, :, :2] = np.linalg.inv(indexed.steps_px)
    square_px = float(np.median(np.linalg.norm(indexed.steps_px, axis=1)))
    reach = float(np.clip(_FIRST_REACH_PX / square_px, _FIRST_REACH_SQUARES, CORNER_REACH_SQUARES))
    fits = locate_corners(image.pixels, image.saturation_dn, indexed.points_px, maps, reach)
    located = _located(indexed.index, fits, None, unambiguous=indexed.unambiguous)
    return replace(located, quarter_turns=indexed.quarter_turns, fewer=indexed.fewer)


def locate_board(
    image: GreyImage, lens: Lens, board: Board, corners_mm: FloatArray, expected: Pose
) -> LocatedBoard:
    """Find the board, then locate all its corners with the lens and the board known.

    The expected pose `T_CS_WS` decides which corners are seen where the board's border does
    not. Where both leave a doubt, the corners themselves decide, by how well they fit the board
    as it was printed. Raises TargetNotFoundError.
    """
    height, width = image.pixels.shape
    expected_px = lens.project(expected.apply(corners_mm))
    inside = (expected_px > 0.0).all(axis=1) & (expected_px < [width, height]).all(axis=1)
    square_px = lens.parameters[0] * board.square_mm / expected.t_mm[2]
    lattice = _lattice(image, square_px, int(inside.sum()))
    candidates = index_near(lattice, board, width, height, expected_px)
    tried = []
    for indexed in candidates:
        pose = _rough_pose(lens, corners_mm, indexed, expected)
        located = refine_board(
            image, lens, pose, board, corners_mm, unambiguous=indexed.unambiguous
        )
        if len(candidates) == 1:
            return located
        tried.append((resect(lens, corners_mm, located.view, pose).median_rms_px, located))
    nearest = tried[0][1]
    tried.sort(key=lambda attempt: attempt[0])
    if tried[1][0] > CLEARLY_BETTER * tried[0][0]:
        return replace(tried[0][1], unambiguous=True)
    return nearest


def _rough_pose(
    lens: Lens, corners_mm: FloatArray, indexed: IndexedLattice, expected: Pose
) -> Pose:
    """Pose from corners that are right to some hundredths of a pixel."""
    covariance = np.broadcast_to(_ROUGH_SIGMA_PX**2 * np.eye(2), (len(indexed.index), 2, 2))
    view = BoardView(indexed.index, indexed.points_px, covariance)
    found = resect(lens, corners_mm, view, expected, settled=_ROUGHLY)
    step_px = float(np.median(np.linalg.norm(indexed.steps_px, axis=1)))
    if found.median_rms_px > _ROUGH_MISFIT_SQUARES * step_px:
        msg = (
            f"sub target: what looks like a board does not fit it, by {found.median_rms_px:.1f} px"
        )
        raise TargetNotFoundError(msg)
    return found.pose


def refine_board(
    image: GreyImage,
    lens: Lens,
    pose: Pose,
    board: Board,
    corners_mm: FloatArray,
    *,
    unambiguous: bool = True,
) -> LocatedBoard:
    """Locate all corners near where a predicted pose `T_CS_WS` puts them.

    The prediction must be right to a third of a square. Raises TargetNotFoundError if no
    corner should be in the image.
    """
    index, points, maps = predict_corners(lens, pose, board, corners_mm, image.pixels.shape)
    if len(index) == 0:
        msg = "sub target: the predicted pose puts no corner into the image"
        raise TargetNotFoundError(msg)
    fits = locate_corners(image.pixels, image.saturation_dn, points, maps)
    return _located(index, fits, pose, unambiguous=unambiguous)


def _lattice(image: GreyImage, square_px: float = 0.0, wanted: int = 0) -> Lattice:
    """Find the board's corners, to some hundredths of a pixel of the image searched.

    Squares expected to be large are found as well in a smaller image; where fewer corners come
    of it than most of those wanted, the next larger one is searched too.
    """
    height, width = image.pixels.shape
    best: Lattice | None = None
    trouble: TargetNotFoundError | None = None
    for factor in (4, 2, 1):
        if factor > 1 and square_px < factor * _LEAST_SQUARE_PX:
            continue
        try:
            saddles = find_saddle_points(_shrunk(image, factor))
            points = factor * saddles.points_px + 0.5 * (factor - 1)
            found = build_lattice(
                replace(saddles, points_px=points), max(BLIND_PX, _BLIND_SHRUNK_PX * factor)
            )
            lattice = without_spurious_lines(found, width, height)
        except TargetNotFoundError as error:
            trouble = error
            continue
        if best is None or len(lattice.ij) > len(best.ij):
            best = lattice
        if len(best.ij) >= _MOST * wanted:
            return best
    if best is None:
        raise trouble or TargetNotFoundError
    return best


def _shrunk(image: GreyImage, factor: int) -> FloatArray:
    """Give the image as float32, at 1/factor of its size by the means of blocks."""
    if factor == 1:
        return as_float(image)
    if factor == 4:
        return shrink(image.pixels)
    half = cv2.resize(image.pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.float32)


def _located(
    index: IntArray, fits: CornerFits, near: Pose | None, *, unambiguous: bool
) -> LocatedBoard:
    usable = fits.usable & _alike(fits)
    view = BoardView(index, fits.points_px, fits.covariance_px2).select(usable)
    if usable.sum() < MIN_CORNERS:
        msg = (
            f"sub target: {int(usable.sum())} of {len(index)} corners are clear enough to "
            f"measure, {MIN_CORNERS} are needed"
        )
        raise TargetNotFoundError(msg)
    return LocatedBoard(
        view,
        unambiguous,
        (fits.light_dn + 0.5 * fits.contrast_dn)[usable],
        (fits.light_dn - 0.5 * fits.contrast_dn)[usable],
        fits.points_px[~usable],
        float(np.median(fits.noise_dn[usable])),
        float(np.median(fits.contrast_dn[usable])),
        float(np.median(fits.blur_px[usable])),
        near,
    )


def _alike(fits: CornerFits) -> BoolArray:
    """Corners whose contrast and residuals are like most others' (not under an insect).

    In shade white and black are darker by the same factor, so that contrast is taken by the light.
    """
    if not fits.usable.any():
        return fits.usable
    noise = np.median(fits.noise_dn[fits.usable])
    by_light = fits.contrast_dn / np.maximum(fits.light_dn, 1.0)
    return np.asarray(
        (fits.noise_dn < _MOST_NOISE * noise)
        & (by_light > _LEAST_CONTRAST * np.median(by_light[fits.usable]))
        & (fits.contrast_dn > _LEAST_SNR * fits.noise_dn)
        & (fits.blur_px < _MOST_BLUR_PX)
    )


def predict_corners(
    lens: Lens, pose: Pose, board: Board, corners_mm: FloatArray, shape: tuple[int, ...]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Corners that a pose puts into an image of shape (h, w).

    Gives their index (n,), points (n, 2) px, and maps (n, 2, 5): board coordinates about the
    corner in squares as polynomials (u, v, u^2, u v, v^2) of the pixel's offset, fitted to a
    3 x 3 stencil of board points.
    """
    height, width = shape
    index, points = visible_corners(lens, pose, corners_mm, (width, height))
    steps = _STENCIL_SQUARES * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    around = corners_mm[index][:, None, :] + np.concatenate(
        [steps * board.square_mm, np.zeros((9, 1))], axis=1
    )
    pixels = lens.project(pose.apply(around.reshape(-1, 3))).reshape(-1, 9, 2)
    maps = np.empty((len(index), 2, TERMS))
    fit_maps(pixels, points, steps, maps)
    return index, points, maps
