"""A reference that shows none of the board's borders in one direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.calibration.calibrate import calibrate
from core.calibration.reference_index import place_reference
from core.calibration.views import Views, find_targets, relocate_corners
from core.checkerboard.board import Board
from core.site import CheckerboardTarget
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.core.scenes import head_positions, lens_views, rest_views, small_site
from tests.core.sessions import Session


def test_a_board_higher_than_the_image_and_off_its_middle_calibrates() -> None:
    """Neither its upper nor its lower border is seen; the lens views know the print."""
    site = replace(small_site(), sub_target=CheckerboardTarget(22, 19, 2.0, 48.0))
    world = World(site, SimSettings(seed=3))
    held = lens_views(world, 12)
    world.slip_board(0.0, 3.0)
    _, report = calibrate([*held, *rest_views(world, head_positions(site, 8))], site)
    assert report.passed
    assert "rejected: 0" in report.lines[1]
    assert not any("not certain" in line for line in report.lines)


@pytest.fixture(scope="module")
def seen(lab: Session) -> tuple[Views, Board]:
    board = Board.nominal(lab.site.sub_target)
    views, _ = find_targets(lab.views, lab.site)
    return relocate_corners(views, lab.calibration.calibrated.lens, board)[0], board


def _named(views: Views, board: Board, right: int, down: int) -> tuple[Views, Views]:
    """The reference's middle part, rightly named, and as if it were elsewhere on the board."""
    located = views.reference.board
    j, i = np.divmod(located.view.index, board.columns)
    middle = (j >= 3) & (j < board.rows - 3) & (i >= 3) & (i < board.columns - 3)
    part = located.view.select(middle)
    away = replace(part, index=board.index(i[middle] + right, j[middle] + down))
    rightly, wrongly = (
        replace(views, reference=replace(views.reference, board=replace(located, view=v)))
        for v in (part, away)
    )
    doubtful = replace(wrongly.reference.board, unambiguous=False)
    return rightly, replace(wrongly, reference=replace(wrongly.reference, board=doubtful))


@pytest.mark.parametrize(("right", "down"), [(0, 2), (0, -2), (1, 1), (2, 0), (0, 0)])
def test_the_print_tells_which_part_of_the_board_it_is(
    lab: Session, seen: tuple[Views, Board], right: int, down: int
) -> None:
    """A period off, the corners fit the nominal board as well, and the lens views contradict."""
    views, board = seen
    rightly, wrongly = _named(views, board, right, down)
    placed = place_reference(wrongly, lab.calibration.calibrated.lens, lab.site, board)
    assert placed.reference.board.unambiguous
    assert np.array_equal(placed.reference.board.view.index, rightly.reference.board.view.index)


def test_without_lens_views_that_show_the_print_nothing_is_claimed(
    lab: Session, seen: tuple[Views, Board]
) -> None:
    views, board = seen
    _, wrongly = _named(views, board, 0, 2)
    few = replace(wrongly, lens=wrongly.lens[:2])
    assert place_reference(few, lab.calibration.calibrated.lens, lab.site, board) is few
