"""Calibration views: what they are for, and the targets found in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from core.checkerboard.board import Board
from core.checkerboard.corners import LocatedBoard, detect_board, locate_board, refine_board
from core.checkerboard.resection import resect
from core.discs.disc_finder import Discs, find_discs
from core.errors import CalibrationError, ImageError, TargetNotFoundError
from core.geometry.lens import Lens
from core.images import GreyImage, require_size
from core.site import Site


class ViewRole(StrEnum):
    """What a calibration view is for (the `role` column of frames.csv)."""

    INTRINSICS = "intrinsics"
    REFERENCE = "reference"
    RIG = "rig"


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """One view given to `calibrate`."""

    name: str
    """How messages call it, e.g. the slot or the file name."""
    role: ViewRole
    main: GreyImage | None
    sub: GreyImage


@dataclass(frozen=True, slots=True)
class LensView:
    """A view of the board with its corners located."""

    name: str
    sub: GreyImage
    board: LocatedBoard


@dataclass(frozen=True, slots=True)
class PairView(LensView):
    """A view of both targets."""

    discs: Discs


@dataclass(frozen=True, slots=True)
class Views:
    """The views with their targets found."""

    reference: PairView
    rig: tuple[PairView, ...]
    lens: tuple[LensView, ...]

    @property
    def all(self) -> tuple[LensView, ...]:
        """Reference, rig and lens views in this order: the order of the poses in a fit."""
        return (self.reference, *self.rig, *self.lens)

    def without(self, names: set[str]) -> Views:
        """Leave out rig and lens views by name."""
        return Views(
            self.reference,
            tuple(v for v in self.rig if v.name not in names),
            tuple(v for v in self.lens if v.name not in names),
        )


RejectedView = tuple[str, str]
"""The name of a view that is not used, and the reason."""


def find_targets(
    views: Sequence[CalibrationView], site: Site, board: Board
) -> tuple[Views, list[RejectedView]]:
    """Find the targets in all views; rig and lens views without them are rejected.

    Raises CalibrationError if there is not exactly one reference, if it shows too little, or if
    there are no rig views at all.
    """
    reference = _reference(views, site, board)
    if not any(v.role is ViewRole.RIG for v in views):
        msg = "calibration: no rig views; move the rig with both targets at rest and take some"
        raise CalibrationError(msg)
    rig: list[PairView] = []
    lens: list[LensView] = []
    rejected: list[RejectedView] = []
    for view in views:
        try:
            if view.role is ViewRole.RIG:
                rig.append(_look_at_both(view, site, board))
            elif view.role is ViewRole.INTRINSICS:
                lens.append(_look_at_board(view, site, board))
        except (TargetNotFoundError, ImageError) as error:
            rejected.append((view.name, str(error)))
    return Views(reference, tuple(rig), tuple(lens)), rejected


def _reference(views: Sequence[CalibrationView], site: Site, board: Board) -> PairView:
    references = [v for v in views if v.role is ViewRole.REFERENCE]
    if len(references) != 1:
        msg = f"calibration: {len(references)} reference views given, exactly one is needed"
        raise CalibrationError(msg)
    try:
        return _look_at_both(references[0], site, board)
    except (TargetNotFoundError, ImageError) as error:
        msg = f"reference view {references[0].name}: {error}; take the reference again"
        raise CalibrationError(msg) from error


def _look_at_board(view: CalibrationView, site: Site, board: Board) -> LensView:
    require_size(view.sub, site.sub, "sub image")
    return LensView(view.name, view.sub, detect_board(view.sub, board))


def _look_at_both(view: CalibrationView, site: Site, board: Board) -> PairView:
    seen = _look_at_board(view, site, board)
    if view.main is None:
        msg = "no main image"
        raise TargetNotFoundError(msg)
    require_size(view.main, site.main, "main image")
    discs = find_discs(view.main, site.main_target, site.nominal_px_per_mm)
    return PairView(seen.name, seen.sub, seen.board, discs)


def relocate_corners(views: Views, lens: Lens, board: Board) -> Views:
    """Locate all corners again, now that the lens is known.

    Where the border does not tell which corners a rig view shows, the reference does.
    """
    nominal = board.corners_mm
    reference = resect(lens, nominal, views.reference.board.view).pose

    def again(view: LensView) -> LocatedBoard:
        pose = resect(lens, nominal, view.board.view).pose
        return refine_board(
            view.sub, lens, pose, board, nominal, unambiguous=view.board.unambiguous
        )

    return Views(
        replace(views.reference, board=again(views.reference)),
        tuple(
            replace(v, board=locate_board(v.sub, lens, board, nominal, reference))
            for v in views.rig
        ),
        tuple(replace(v, board=again(v)) for v in views.lens),
    )
