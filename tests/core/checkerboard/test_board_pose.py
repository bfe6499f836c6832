"""The functions for images of a board by themselves: a lens from them, a pose from one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.checkerboard.board import Board
from core.checkerboard.board_pose import board_pose
from core.checkerboard.corners import LocatedBoard, detect_board
from core.errors import TargetNotFoundError
from core.geometry.pose import Pose
from core.images import GreyImage
from core.lens.intrinsics import calibrate_lens
from core.site import CheckerboardTarget
from tests.core.boards import AS_CORE, BoardScene

SMALL = BoardScene(CheckerboardTarget(10, 7, 4.0, 0.0))
"""All of it is in the image."""


@pytest.mark.parametrize("turn_deg", [(4.0, -6.0, 3.0), (20.0, 5.0, -80.0), (5.0, -8.0, 178.0)])
def test_pose_is_right_to_its_covariance(turn_deg: tuple[float, float, float]) -> None:
    """Which corner is which, the colours tell for a board of 10x7 squares, even upside down."""
    scene = replace(SMALL, turn_deg=turn_deg, middle_mm=(1.0, -1.5, 75.0))
    seen = board_pose(scene.image(), AS_CORE, scene.board)
    assert len(seen.view.index) == 54
    turn = seen.fit.pose.R @ scene.pose.R.T
    off = np.concatenate(
        [Pose(turn, np.zeros(3)).rotation_rad, seen.fit.pose.t_mm - scene.pose.t_mm]
    )
    sigmas = np.sqrt(np.diag(seen.fit.covariance))
    assert (np.abs(off) < 5.0 * sigmas).all()
    assert sigmas[:3].max() < 1e-3
    assert sigmas[3:].max() < 0.02


def test_a_board_of_which_too_little_is_seen_is_refused() -> None:
    """Without any border in the image nothing says which corners these are."""
    wide = BoardScene(CheckerboardTarget(60, 60, 2.0, 50.0))
    with pytest.raises(TargetNotFoundError, match="which part of it is seen is not certain"):
        board_pose(wide.image(), AS_CORE, wide.board)


def _ten_views() -> list[GreyImage]:
    tilts = [(20.0, 0.0), (-20.0, 0.0), (0.0, 20.0), (0.0, -20.0), (15.0, 15.0)]
    places = [(-10.0, -5.0), (10.0, -5.0), (-10.0, 5.0), (10.0, 5.0), (0.0, 0.0)]
    return [
        replace(SMALL, turn_deg=(*tilt, 5.0 * k), middle_mm=(*place, z)).image(k)
        for z in (60.0, 75.0)
        for k, (tilt, place) in enumerate(zip(tilts, places, strict=True))
    ]


def test_a_lens_from_images_of_which_nothing_is_known() -> None:
    """Ten views calibrate it; the one without the board is named, with the reason."""
    images = _ten_views()
    images.insert(3, GreyImage(np.full((300, 480), 90, dtype=np.uint8)))
    found = calibrate_lens(images, SMALL.board)
    assert [k for k, _ in found.rejected] == [3]
    assert found.lens.parameters[:2] == pytest.approx(AS_CORE.parameters[:2], rel=2e-3)
    u, v = np.meshgrid(np.linspace(40, 440, 9), np.linspace(40, 260, 6))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    angle = np.arccos((found.lens.rays(pixels) * AS_CORE.rays(pixels)).sum(axis=1))
    assert angle.max() < 5e-3


def test_a_stray_among_the_first_corners_costs_no_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the lens a corner of one view is taken for another; with it, all are found."""
    found_first = []

    def astray(image: GreyImage, board: Board) -> LocatedBoard:
        found = detect_board(image, board)
        found_first.append(found)
        if len(found_first) == 5:
            found.view.points_px[20] += [25.0, -18.0]
        return found

    monkeypatch.setattr("core.lens.intrinsics.detect_board", astray)
    found = calibrate_lens(_ten_views(), SMALL.board)
    assert found.rejected == ()
    assert found.lens.parameters[:2] == pytest.approx(AS_CORE.parameters[:2], rel=2e-3)
