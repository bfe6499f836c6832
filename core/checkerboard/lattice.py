"""Saddle points joined into the lattice of a checkerboard, and the lattice's place on the board."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from core.arrays import BoolArray, FloatArray, IntArray
from core.checkerboard.board import Board
from core.checkerboard.board_mismatch import no_place
from core.checkerboard.lattice_kernels import keep_mutual, largest_component, link_arms
from core.checkerboard.saddle_points import SaddlePoints
from core.errors import NotRecognisedError, TargetNotFoundError

_NEIGHBOURS = 13
"""Nearest saddle points among which a corner's four neighbours are sought, itself counted in.
Chosen: twelve reach the next corner along each edge where it looks twice as far as across it;
insensitive."""
_MIN_CORNERS = 12
"""Of a lattice: fewer also come about by chance, in foliage or brickwork."""
BLIND_PX = 12.0
"""Nearer to the edge of an image no saddle point is found: its ring and its blur would not fit."""
_LEAST_BORDER_CORNERS = 3
"""Of a border: so many corners must have a next one that ought to be in the image."""
_MOST_OF_BORDER = 0.5
"""The share of those next corners that must lie well inside the image: more than half."""
_CLEARLY_NEARER = 0.5
"""The prediction decides if it is no further from one place than this share of the distance to the
next one, two squares on or a diagonal step: off by a third of that step it still decides."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """Corners with lattice coordinates (i to the right, j down), known up to a shift."""

    ij: IntArray
    """(n, 2) integers, smallest 0."""
    points_px: FloatArray
    """(n, 2)."""
    polarity: FloatArray
    """(n,) +1 where the square up and left of the corner is black."""
    blind_px: float = BLIND_PX
    """Corners nearer than this to the edge of the image were not looked for."""


def build_lattice(saddles: SaddlePoints, blind_px: float = BLIND_PX) -> Lattice:
    """Join saddle points into the largest lattice. Raises TargetNotFoundError.

    >>> from core.checkerboard.saddle_points import find_saddle_points
    >>> image = np.kron(np.indices((5, 6)).sum(axis=0) % 2, np.full((20, 20), 200.0))
    >>> lattice = build_lattice(find_saddle_points(image))
    >>> (lattice.ij.max(axis=0) + 1).tolist()
    [5, 4]
    """
    if len(saddles.points_px) < _MIN_CORNERS:
        msg = f"no checkerboard: only {len(saddles.points_px)} corner candidates in the image"
        raise TargetNotFoundError(msg)
    arms, links = _links(saddles)
    index, labels = largest_component(arms, links)
    if len(index) < _MIN_CORNERS:
        msg = f"no checkerboard: the largest lattice in the image has {len(index)} corners"
        raise TargetNotFoundError(msg)
    return replace(_upright(index, labels, saddles, arms), blind_px=blind_px)


def _links(saddles: SaddlePoints) -> tuple[FloatArray, IntArray]:
    """Arms (n, 4, 2), clockwise, and for each arm the saddle it leads to (n, 4), or -1."""
    points = saddles.points_px
    n = len(points)
    a, b = saddles.directions_rad[:, 0], saddles.directions_rad[:, 1]
    arms = np.stack(
        [np.stack([np.cos(t), np.sin(t)], axis=1) for t in (a, b, a + np.pi, b + np.pi)], axis=1
    )
    nearest = cKDTree(points).query(points, k=min(_NEIGHBOURS, n))[1]
    near = np.asarray(nearest, dtype=np.int64)[:, 1:]
    links, mutual = np.empty((2, n, 4), dtype=np.int64)
    link_arms(points, near, arms, saddles.polarity, links)
    keep_mutual(links, mutual)
    return arms, mutual


def _upright(index: IntArray, labels: IntArray, saddles: SaddlePoints, arms: FloatArray) -> Lattice:
    """Turn the lattice by quarter turns until +i points to the right."""
    ij, first_arm = labels[:, :2], labels[:, 2]
    rightness = [arms[index, (first_arm + quarter) % 4, 0].mean() for quarter in range(4)]
    quarter = int(np.argmax(rightness))
    for _ in range(quarter):  # +i becomes what was +j
        ij = np.stack([ij[:, 1], -ij[:, 0]], axis=1)
    arm = (first_arm + quarter) % 4
    clockwise_sector_bright = saddles.polarity[index] * np.where(arm % 2 == 0, 1.0, -1.0)
    return Lattice(
        ij - ij.min(axis=0),
        saddles.points_px[index],
        # The sector clockwise of +i is down and right; up and left is its opposite, alike.
        -clockwise_sector_bright,
    )


Fewer = tuple[int | None, int | None] | None
"""Columns and rows of corners between two borders that are both seen, where they are fewer than the
board's: another board, or something covers its border. None where they are not."""


@dataclass(frozen=True, slots=True)
class IndexedLattice:
    """Corners of a lattice with their index on the board."""

    index: IntArray
    """(n,) index into Board.corners_mm."""
    points_px: FloatArray
    """(n, 2)."""
    steps_px: FloatArray
    """(n, 2, 2) d(px)/d(square): columns are one square along i and along j."""
    unambiguous: bool
    """False if another position on the board would fit as well."""
    quarter_turns: int = 0
    """By how many quarter turns the board had to be turned to fit."""
    fewer: Fewer = None


def index_by_borders(
    lattice: Lattice, board: Board, width_px: int, height_px: int
) -> IndexedLattice:
    """Find which corners of the board a lattice shows, from its parity and the board's border.

    Where several positions remain, the middle one is taken and `unambiguous` is False. Turns by
    quarter turns are tried in the order upright, right, left, upside down.
    Raises TargetNotFoundError.
    """
    for quarter in (0, 1, 3, 2):
        turned = _turned(lattice, quarter)
        places = _at_borders(turned, board, _places(turned, board), width_px, height_px)
        if places:
            middle = places[len(places) // 2]
            found = _indexed(turned, board, middle, unambiguous=len(places) == 1)
            fewer = _fewer_between_borders(turned, board, width_px, height_px)
            return replace(found, quarter_turns=quarter, fewer=fewer)
    raise _no_place(lattice, board)


def index_near(
    lattice: Lattice, board: Board, width_px: int, height_px: int, expected_px: FloatArray
) -> tuple[IndexedLattice, ...]:
    """Give the places that a lattice may have on the board, the nearest to a prediction first.

    expected_px (corners, 2) is the predicted image of all corners. One place comes back, and is
    unambiguous, if the prediction decides clearly and the borders seen do not speak against it.
    What covers a part of the board can look like its border, so the nearest place counts even
    against the borders. Raises TargetNotFoundError.
    """
    places = _places(lattice, board)
    if not places:
        raise _no_place(lattice, board)
    ij = lattice.ij
    away = {}
    for i, j in places:
        miss = lattice.points_px - expected_px[board.index(ij[:, 0] + i, ij[:, 1] + j)]
        away[i, j] = float(np.median(np.hypot(miss[:, 0], miss[:, 1])))
    places.sort(key=away.__getitem__)
    bordered = _at_borders(lattice, board, places, width_px, height_px)
    candidates = [places[0], *bordered[:1]]
    # Places lie a diagonal step apart or more; the prediction must be much nearer to one.
    if (
        len(places) > 1
        and len(bordered) != 1
        and away[places[0]] > _CLEARLY_NEARER * away[places[1]]
    ):
        candidates.append(places[1])
    unique = list(dict.fromkeys(candidates))
    return tuple(_indexed(lattice, board, place, unambiguous=len(unique) == 1) for place in unique)


def _indexed(
    lattice: Lattice, board: Board, place: tuple[int, int], *, unambiguous: bool
) -> IndexedLattice:
    ij = lattice.ij + place
    index = board.index(ij[:, 0], ij[:, 1])
    return IndexedLattice(index, lattice.points_px, _steps(lattice), unambiguous)


def _no_place(lattice: Lattice, board: Board) -> NotRecognisedError:
    columns, rows = (lattice.ij.max(axis=0) + 1).tolist()
    return no_place(columns, rows, board)


def _turned(lattice: Lattice, quarter: int) -> Lattice:
    ij, polarity = lattice.ij, lattice.polarity
    for _ in range(quarter):
        ij = np.stack([ij[:, 1], -ij[:, 0]], axis=1)
        polarity = -polarity  # the sector up and left is now one of the other colour
    return replace(lattice, ij=ij - ij.min(axis=0), polarity=polarity)


def _places(lattice: Lattice, board: Board) -> list[tuple[int, int]]:
    """Shifts (i, j) at which the lattice lies on the board with its parity right."""
    room = np.array([board.columns, board.rows]) - lattice.ij.max(axis=0) - 1
    even = (lattice.ij.sum(axis=1) % 2 == 0) == (lattice.polarity > 0)
    odd_shift = int(even.mean() < 0.5)
    return [
        (i, j) for i in range(room[0] + 1) for j in range(room[1] + 1) if (i + j) % 2 == odd_shift
    ]


def _at_borders(
    lattice: Lattice,
    board: Board,
    places: list[tuple[int, int]],
    width_px: int,
    height_px: int,
) -> list[tuple[int, int]]:
    """Keep the places that agree with the borders seen.

    Two borders nearer to each other than the board is long say nothing: one is a cover's edge.
    """
    room = np.array([board.columns, board.rows]) - lattice.ij.max(axis=0) - 1
    borders = _borders(lattice, width_px, height_px)
    fitting = places
    for axis in range(2):
        at_start, at_end = borders[axis]
        if at_start and at_end and room[axis] > 0:
            continue  # one of the two is a cover's edge
        if at_start:
            fitting = [place for place in fitting if place[axis] == 0]
        if at_end:
            fitting = [place for place in fitting if place[axis] == room[axis]]
    return fitting


def _fewer_between_borders(lattice: Lattice, board: Board, width_px: int, height_px: int) -> Fewer:
    size, whole = lattice.ij.max(axis=0) + 1, np.array([board.columns, board.rows])
    if (size == whole).all():
        return None
    few = _borders(lattice, width_px, height_px).all(axis=1) & (size < whole)
    columns, rows = (int(count) if less else None for count, less in zip(size, few, strict=True))
    return (columns, rows) if few.any() else None


def grid_of(lattice: Lattice) -> FloatArray:
    """Points on their lattice, (j, i, 2), NaN where there is none, with a margin of one."""
    size = lattice.ij.max(axis=0) + 3
    grid = np.full((size[1], size[0], 2), np.nan)
    grid[lattice.ij[:, 1] + 1, lattice.ij[:, 0] + 1] = lattice.points_px
    return grid


def _borders(lattice: Lattice, width_px: int, height_px: int) -> BoolArray:
    """(2, 2): whether the board itself ends at the start and the end of each axis.

    It does if most next corners, extrapolated, would lie well inside the image.
    """
    grid = grid_of(lattice)
    answer = np.zeros((2, 2), dtype=bool)
    for axis in range(2):
        lines = grid if axis == 1 else grid.transpose(1, 0, 2)
        for end in range(2):
            last, before = (lines[1], lines[2]) if end == 0 else (lines[-2], lines[-3])
            beyond = 2.0 * last - before
            beyond = beyond[np.isfinite(beyond).all(axis=1)]
            if len(beyond) < _LEAST_BORDER_CORNERS:
                continue
            margin = lattice.blind_px
            inside = (
                (beyond > margin).all(axis=1)
                & (beyond[:, 0] < width_px - 1 - margin)
                & (beyond[:, 1] < height_px - 1 - margin)
            )
            answer[axis, end] = inside.mean() > _MOST_OF_BORDER
    return answer


def _steps(lattice: Lattice) -> FloatArray:
    """d(px)/d(square) at each corner from its neighbours, central where both are there."""
    grid = grid_of(lattice)
    steps = np.empty((len(lattice.ij), 2, 2))
    j, i = lattice.ij[:, 1] + 1, lattice.ij[:, 0] + 1
    for axis, (dj, di) in enumerate(((0, 1), (1, 0))):
        after, before, here = grid[j + dj, i + di], grid[j - dj, i - di], grid[j, i]
        central = 0.5 * (after - before)
        one_sided = np.where(np.isfinite(after), after - here, here - before)
        steps[:, :, axis] = np.where(np.isfinite(central), central, one_sided)
    lonely = ~np.isfinite(steps).all(axis=(1, 2))
    if lonely.any():
        known = np.nonzero(~lonely)[0]
        _, nearest = cKDTree(lattice.points_px[known]).query(lattice.points_px[lonely])
        steps[lonely] = steps[known[nearest]]
    return steps
