"""Lens and rig views that are said to be mirrored, where their colours and the lens tell it."""

from __future__ import annotations

from collections.abc import Sequence

from core.calibration.joint_fit import Fit
from core.calibration.reference_index import LEAST_VIEWS, as_printed
from core.calibration.views import LensView, RejectedView, Views
from core.checkerboard.board import Board
from core.checkerboard.board_mismatch import turns_if_mirrored
from core.geometry.lens import Lens
from core.lens.mirrored import MIRRORED, looks_mirrored
from core.site import Site


def mirrored_lens_views(views: Views, lens: Lens, site: Site, board: Board) -> list[RejectedView]:
    """All lens views, if they are mirrored or turned against the reference and the rig views.

    lens is what the lens views give. That they show the board turned says nothing by itself, as it
    may have been held so. But then the views of the mounted board fit their lens and print, and
    would not fit them better mirrored.
    """
    mirrored = turns_if_mirrored(board)
    alike = all(view.board.quarter_turns == mirrored for view in views.lens)
    if not alike or len(views.lens) < LEAST_VIEWS:
        return []
    lens, corners_mm = as_printed(views.lens, lens, site, board)
    mounted: Sequence[LensView] = (views.reference, *views.rig)
    size = site.sub.width_px, site.sub.height_px
    against = [looks_mirrored(v.board.view, lens, board, corners_mm, size) for v in mounted]
    if 2 * sum(against) <= len(against):
        return []
    return [(view.name, MIRRORED) for view in views.lens]


def with_mirrored_named(
    rejected: Sequence[RejectedView], found: Views, fit: Fit, site: Site, board: Board
) -> list[RejectedView]:
    """The rejected views, those that fit the others mirrored with this as their reason.

    found are all views, as they were before any was rejected.
    """
    views = {view.name: view.board.view for view in found.all}
    lens, corners_mm = fit.adjustment.lens, fit.adjustment.corners_mm
    size = site.sub.width_px, site.sub.height_px
    return [
        (name, MIRRORED)
        if looks_mirrored(views[name], lens, board, corners_mm, size)
        else (name, reason)
        for name, reason in rejected
    ]
