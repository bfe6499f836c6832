"""Which part of the board the reference shows, where none of the board's borders tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from core.adjustment.bundle_adjustment import adjust
from core.adjustment.normal_equations import AdjustmentPriors
from core.arrays import FloatArray, IntArray
from core.calibration.views import LensView, Views
from core.checkerboard.board import Board
from core.checkerboard.corners import CLEARLY_BETTER
from core.checkerboard.resection import BoardView, resect
from core.geometry.lens import Lens
from core.lens.intrinsics import lens_prior
from core.site import Site

LEAST_VIEWS = 3
"""Lens views that show a border each way: so many determine how the board was printed."""


def place_reference(views: Views, lens: Lens, site: Site, board: Board) -> Views:
    """Name the reference's corners by the print: by the place where they fit the board as printed.

    How the board was printed, the lens views tell that show a border each way. The views come
    back as they are if the reference is certain, such lens views are too few, or no place fits
    clearly better than the others.
    """
    known = [view for view in views.lens if view.board.unambiguous]
    if views.reference.board.unambiguous or len(known) < LEAST_VIEWS:
        return views
    lens, corners_mm = as_printed(known, lens, site, board)
    seen = views.reference.board.view
    places = [replace(seen, index=index) for index in _places(seen.index, board)]
    outliers = [resect(lens, corners_mm, place).median_rms_px for place in places]
    order = np.argsort(outliers)
    if len(order) > 1 and outliers[order[1]] < CLEARLY_BETTER * outliers[order[0]]:
        return views
    placed = replace(views.reference.board, view=places[order[0]], unambiguous=True)
    return replace(views, reference=replace(views.reference, board=placed))


def as_printed(
    views: Sequence[LensView], lens: Lens, site: Site, board: Board
) -> tuple[Lens, FloatArray]:
    """The lens and the corners (corners, 3) mm that lens views alone give."""
    boards: list[BoardView] = [view.board.view for view in views]
    poses = [resect(lens, board.corners_mm, seen).pose for seen in boards]
    priors = AdjustmentPriors(
        lens=lens_prior(site.sub, model=lens.model), scale=site.sub_target.scale_sigma
    )
    adjusted = adjust(board, boards, lens, poses, priors)
    return adjusted.lens, adjusted.corners_mm


def _places(index: IntArray, board: Board) -> list[IntArray]:
    """The corners' indices in every place on the board that has the colours right."""
    j, i = np.divmod(index, board.columns)
    return [
        board.index(i + right, j + down)
        for right in range(-int(i.min()), board.columns - int(i.max()))
        for down in range(-int(j.min()), board.rows - int(j.max()))
        if (right + down) % 2 == 0
    ]
