"""Calibration views: what they are for, and the targets found in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeVar

import numpy as np

from core.checkerboard.board import Board
from core.checkerboard.board_mismatch import turned
from core.checkerboard.corners import LocatedBoard, locate_board, refine_board
from core.checkerboard.resection import resect
from core.discs.disc_finder import Discs
from core.errors import CalibrationError, ImageError, NotRecognisedError, TargetNotFoundError
from core.geometry.lens import Lens
from core.images import GreyImage, require_size
from core.moment import Moment
from core.recognition import (
    board_doubt,
    recognise_board,
    recognise_mounted_board,
    recognise_targets,
)
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
    moment: Moment | None = None
    """When it was taken; needed of the reference alone."""
    main_name: str | None = None
    """How messages that are about its main image call it; None: as others do."""

    def called(self, reason: str) -> str:
        """Give the name to say before a reason, which begins with the target or image at fault."""
        return self.main_name or self.name if reason.startswith("main ") else self.name


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
    """Of the main target."""
    further: tuple[Discs | None, ...] = ()
    """Of the further targets, in the order of the site; None where one is not seen."""


_View = TypeVar("_View", bound=LensView)


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


def find_targets(views: Sequence[CalibrationView], site: Site) -> tuple[Views, list[RejectedView]]:
    """Find the targets in all views; rig and lens views without them are rejected.

    Raises CalibrationError if there is not exactly one reference, if it shows too little or other
    targets than the site's, or if no rig view is given or can be used.
    """
    reference = _reference(views, site)
    if not any(v.role is ViewRole.RIG for v in views):
        msg = "calibration: no rig views; move the rig with both targets at rest and take some"
        raise CalibrationError(msg)
    rig: list[PairView] = []
    lens: list[LensView] = []
    rejected: list[RejectedView] = []
    unusable: list[RejectedView] = []
    for view in views:
        try:
            if view.role is ViewRole.RIG:
                rig.append(_look_at_both(view, site, reference))
            elif view.role is ViewRole.INTRINSICS:
                lens.append(_look_at_board(view, site))
        except (TargetNotFoundError, ImageError) as error:
            rejected.append((view.name, str(error)))
            if view.role is ViewRole.RIG:
                unusable.append((view.called(str(error)), str(error)))
    _require_rig(rig, unusable)
    _require_mounted_rig(rig, site)
    seen = Views(reference, tuple(rig), tuple(lens))
    _require_whole_board(seen, site)
    return seen, rejected


def _require_rig(rig: Sequence[PairView], rejected: Sequence[RejectedView]) -> None:
    """Raise CalibrationError if no rig view is left; rejected are those that are not."""
    if not rig:
        name, reason = rejected[0]
        msg = f"calibration: none of the rig views can be used; {name}: {reason}"
        raise CalibrationError(msg)


def _require_mounted_rig(rig: Sequence[PairView], site: Site) -> None:
    """Raise CalibrationError if all rig views show the board turned, as a cover alone does not."""
    if all(view.board.quarter_turns and view.board.fewer is None for view in rig):
        reason = str(turned(rig[0].board.quarter_turns, Board.nominal(site.sub_target)))
        _require_rig([], [(rig[0].name, reason)])


def _require_whole_board(views: Views, site: Site) -> None:
    """Raise CalibrationError if no view shows as large a board as the config has."""
    doubt = board_doubt(views.reference.board, site)
    fewer = views.reference.board.fewer
    if doubt is None or fewer is None or not views.lens:
        return
    columns = site.sub_target.squares_x - 1
    for view in views.all:
        if view.board.quarter_turns % 2:
            continue  # by the wrong count: its columns may be taken for rows
        j, i = np.divmod(view.board.view.index, columns)
        spans = zip((i, j), fewer, strict=True)
        if any(count is not None and np.ptp(axis) + 1 > count for axis, count in spans):
            return  # something covered a border of the board in the reference
    msg = f"{views.reference.name}: {doubt}"
    raise CalibrationError(msg)


def _reference(views: Sequence[CalibrationView], site: Site) -> PairView:
    references = [v for v in views if v.role is ViewRole.REFERENCE]
    if len(references) != 1:
        msg = f"calibration: {len(references)} reference views given, exactly one is needed"
        raise CalibrationError(msg)
    try:
        seen = _look_at_both(references[0], site, mounted=True)
    except NotRecognisedError as error:
        msg = f"{references[0].called(str(error))}: {error}"
        raise CalibrationError(msg) from error
    except (TargetNotFoundError, ImageError) as error:
        msg = f"{references[0].called(str(error))}: {error}; take the reference again"
        raise CalibrationError(msg) from error
    return seen


def _look_at_board(view: CalibrationView, site: Site, *, mounted: bool = False) -> LensView:
    require_size(view.sub, site.sub, "sub image")
    see = recognise_mounted_board if mounted else recognise_board
    return LensView(view.name, view.sub, see(view.sub, site))


def _look_at_both(
    view: CalibrationView,
    site: Site,
    reference: PairView | None = None,
    *,
    mounted: bool = False,
) -> PairView:
    seen = _look_at_board(view, site, mounted=mounted)
    if view.main is None:
        msg = "no main image"
        raise TargetNotFoundError(msg)
    require_size(view.main, site.main, "main image")
    before = None if reference is None else (reference.discs, *reference.further)
    discs, further = recognise_targets(view.main, site, before)
    return PairView(seen.name, seen.sub, seen.board, discs, further)


def relocate_corners(views: Views, lens: Lens, board: Board) -> tuple[Views, list[RejectedView]]:
    """Locate all corners again, now that the lens is known; rig and lens views may be rejected.

    Where the border does not tell which corners a rig view shows, the reference does. Raises
    CalibrationError where the reference or all rig views would be rejected.
    """
    nominal = board.corners_mm
    expected = resect(lens, nominal, views.reference.board.view).pose
    rejected: list[RejectedView] = []

    def again(view: LensView) -> LocatedBoard:
        pose = resect(lens, nominal, view.board.view).pose
        return refine_board(
            view.sub, lens, pose, board, nominal, unambiguous=view.board.unambiguous
        )

    def by_reference(view: LensView) -> LocatedBoard:
        return locate_board(view.sub, lens, board, nominal, expected)

    def located(views: Sequence[_View], locate: Callable[[LensView], LocatedBoard]) -> list[_View]:
        kept = []
        for view in views:
            try:
                kept.append(_with_board(view, locate(view)))
            except TargetNotFoundError as error:
                rejected.append((view.name, str(error)))
        return kept

    reference, rig = located([views.reference], again), located(views.rig, by_reference)
    if not reference:
        msg = f"{views.reference.name}: {rejected[0][1]}; take the reference again"
        raise CalibrationError(msg)
    _require_rig(rig, rejected)
    return Views(reference[0], tuple(rig), tuple(located(views.lens, again))), rejected


def _with_board(view: _View, board: LocatedBoard) -> _View:
    turns = view.board.quarter_turns  # not known to a board that was located by its pose
    return replace(view, board=replace(board, quarter_turns=turns))
