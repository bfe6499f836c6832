"""Corners that are not the board's but line up with it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.checkerboard.corners import detect_board
from core.images import GreyImage
from core.site import CheckerboardTarget
from tests.core.boards import LENS, BoardScene

SMALL = CheckerboardTarget(10, 7, 4.0, 50.0)


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (-35.0, 20.0, 0.0)])
def test_dark_patches_at_the_border_are_not_taken_for_the_board(turn_deg) -> None:
    """A dark square beyond each border continues the pattern; all 54 corners stay the board's."""
    scene = BoardScene(target=SMALL, turn_deg=turn_deg)
    pixels = scene.image().pixels.copy()
    for square in [(3, -1), (5, 7), (-1, 3), (10, 4)]:
        cv2.fillConvexPoly(pixels, _outline(scene, *square), 20, cv2.LINE_AA)
    seen = detect_board(GreyImage(pixels), scene.board)
    assert seen.unambiguous
    inside = scene.inside(8.0)
    assert set(inside) <= set(seen.view.index.tolist())
    miss = seen.view.points_px - scene.corners_px[seen.view.index]
    assert np.median(np.abs(miss)) < 0.05


def _outline(scene: BoardScene, i: int, j: int) -> np.ndarray:
    """The image of one square, counted from the origin, which may lie beyond the board."""
    mm = scene.target.square_mm
    corners = np.array([(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)], dtype=float) * mm
    points = LENS.project(scene.pose.apply(np.column_stack([corners, np.zeros(4)])))
    return np.round(points).astype(np.int32)
