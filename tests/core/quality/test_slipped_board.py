"""A board that is not where, or not what, it was at calibration: no row of it is called good."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from core.checkerboard.corners import locate_board
from core.checkerboard.resection import BoardView, resect
from core.images import GreyImage
from core.measurement import measure_pair
from core.quality.print_fingerprint import print_mismatch
from core.results import Flag, Reason
from tests.core.scenes import MINUTE, grey
from tests.core.sessions import Session
from tests.exhaustive import one_of


@pytest.fixture(scope="module", params=[1.0, 4.0, 10.0], ids=lambda um: f"{um:g}um")
def lab(request, printed: Callable[[float], Session]) -> Session:
    """Boards whose lines are off by less and by more than a printer's."""
    return printed(request.param)


def sub_image(lab: Session, minute: int) -> GreyImage:
    return grey(lab.world, "sub", lab.world.settings.start_utc + minute * MINUTE)


@pytest.mark.parametrize("squares", [(2, 0), (0, 2), (1, 1), (-2, 4)][:: one_of(2)])
def test_corners_named_a_period_off_lack_the_calibrated_print_errors(lab, squares):
    calibrated = lab.calibration.calibrated
    view = locate_board(
        sub_image(lab, 60),
        calibrated.lens,
        calibrated.board,
        calibrated.corners_mm,
        calibrated.reference_pose,
    ).view
    row, column = np.divmod(view.index, calibrated.board.columns)
    column, row = column + squares[0], row + squares[1]
    there = (
        (column >= 0)
        & (column < calibrated.board.columns)
        & (row >= 0)
        & (row < calibrated.board.rows)
    )
    seen = view.select(there)
    named = BoardView(
        (row * calibrated.board.columns + column)[there], seen.points_px, seen.covariance_px2
    )
    assert (
        print_mismatch(calibrated, view, resect(calibrated.lens, calibrated.corners_mm, view))[0]
        < 0.1
    )
    assert (
        print_mismatch(calibrated, named, resect(calibrated.lens, calibrated.corners_mm, named))[0]
        > 0.35
    )


@pytest.mark.parametrize("seed", [11, 12, 13][:: one_of(3)])
def test_another_print_of_the_same_drawing_is_noticed(lab, seed):
    lab.world.replace_board(seed)
    try:
        measured = lab.row(lab.world.settings.start_utc + 60 * MINUTE).measurement
    finally:
        lab.world.replace_board(None)
    assert measured.flag is Flag.SUSPECT
    assert Reason.SUB_TARGET_CHANGED in measured.reasons


def test_a_board_turned_on_the_pier_is_not_good(lab):
    """The main target has not rolled with it."""
    lab.world.slip_board(0.7, 0.0, 0.5)
    try:
        main, sub = lab.pair(lab.world.settings.start_utc + 60 * MINUTE)
    finally:
        lab.world.slip_board(0.0, 0.0)
    assert measure_pair(main, sub, lab.site, lab.calibration).flag is not Flag.GOOD
