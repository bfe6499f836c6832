"""Lattice lines that are not the board's: chance corners beyond its border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.lattice import Lattice, grid_of

_SHARE = 0.4
"""Of a line's corners that ought to be in the image: a line with fewer is not the board's. Chosen
between the few that line up by chance and the many that are seen of a dirty board; insensitive."""
_SPARE_PX = 4.0
"""A line that would be this near to where corners are not looked for any more counts as seen."""


def without_spurious_lines(lattice: Lattice, width_px: int, height_px: int) -> Lattice:
    """Drop outer lines of which most corners ought to be seen in the image but are not.

    A frame printed about a board, or a finger at its edge, gives corners of its own that line up
    with the lattice; but not a whole line of them.
    """
    while True:
        keep = np.ones(len(lattice.ij), dtype=bool)
        for axis in range(2):
            first, last = _full_lines(lattice, axis, width_px, height_px)
            keep &= (lattice.ij[:, axis] >= first) & (lattice.ij[:, axis] <= last)
        if keep.all():
            return lattice
        ij = lattice.ij[keep]
        lattice = replace(
            lattice,
            ij=ij - ij.min(axis=0),
            points_px=lattice.points_px[keep],
            polarity=lattice.polarity[keep],
        )


def _full_lines(lattice: Lattice, axis: int, width_px: int, height_px: int) -> tuple[int, int]:
    """The first and the last line up to which, from the fullest one on, none is sparse."""
    grid = grid_of(lattice)[1:-1, 1:-1]
    lines = grid if axis == 1 else grid.transpose(1, 0, 2)
    count = np.isfinite(lines[:, :, 0]).sum(axis=1)
    fullest = int(np.argmax(count))
    margin_px = lattice.blind_px - _SPARE_PX
    ends = []
    for step in (-1, 1):
        at = fullest
        while 0 <= at + step < len(lines):
            behind = at - step
            there = 2.0 * lines[at] - lines[behind] if 0 <= behind < len(lines) else lines[at]
            if count[at + step] < _SHARE * _inside(there, width_px, height_px, margin_px):
                break
            at += step
        ends.append(at)
    return ends[0], ends[1]


def _inside(points_px: FloatArray, width_px: int, height_px: int, margin_px: float) -> int:
    """How many points are well inside the image; NaN are not."""
    size = np.array([width_px, height_px]) - 1 - margin_px
    return int(((points_px > margin_px) & (points_px < size)).all(axis=1).sum())
