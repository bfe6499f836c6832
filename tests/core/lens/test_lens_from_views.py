"""A lens from views of a board of which nothing is known and a third may be wrong."""

from __future__ import annotations

import numpy as np
import pytest

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.resection import BoardView
from core.errors import CalibrationError
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens.intrinsics import calibrate_lens_from_corners
from core.lens.mirrored import looks_mirrored
from core.lens_model import LensModel
from core.site import CheckerboardTarget
from tests.exhaustive import one_of

BOARD = Board.nominal(CheckerboardTarget(10, 7, 30.0, 0.0))
SIZE = (640, 480)
LENSES = {
    "fisheye": Lens(
        np.array([205.0, 205.2, 0.0, 322.0, 238.0, 0.01, -0.004, 0.001, -0.0003]),
        LensModel.FISHEYE,
    ),
    "tangent": Lens(
        np.array([535.0, 534.6, 0.0, 328.0, 236.0, -0.28, 0.1, 1e-3, -5e-4, -0.02]),
        LensModel.BROWN,
    ),
}
every_lens = pytest.mark.parametrize("name", list(LENSES))


every_seed = pytest.mark.parametrize("seed", [1, 6][:: one_of(2)])


def true_views(lens: Lens, rng: np.random.Generator, count: int = 15) -> list[FloatArray]:
    """Corners (6, 9, 2) of boards all over the image, tilted to 40 degrees."""
    views: list[FloatArray] = []
    middle = BOARD.corners_mm.mean(axis=0)
    while len(views) < count:
        ray = lens.rays(rng.uniform((60, 60), (580, 420), (1, 2)))[0]
        facing = np.cross([0.0, 0.0, 1.0], ray)
        sine = np.linalg.norm(facing)
        turn = facing / sine * np.arctan2(sine, ray[2])
        R = (
            Pose.from_vectors(turn, np.zeros(3))
            .compose(Pose.from_vectors(rng.uniform(-0.6, 0.6, 3), np.zeros(3)))
            .R
        )
        pose = Pose(R, ray * rng.uniform(1.5, 2.4) * lens.parameters[0] - R @ middle)
        points = pose.apply(BOARD.corners_mm)
        pixels = lens.project(points)
        if lens.sees(points).all() and (pixels > 5).all() and (pixels < np.array(SIZE) - 6).all():
            views.append(pixels.reshape(6, 9, 2))
    return views


def noisy(
    views: list[FloatArray], rng: np.random.Generator, sigma_px: float = 0.1
) -> list[FloatArray]:
    """The same corners as a finder with noise gives them."""
    return [view + rng.normal(0.0, sigma_px, view.shape) for view in views]


def _spoilt(views: list[FloatArray]) -> list[FloatArray]:
    """Five of the views as a finder gone wrong gives them."""
    spoilt = [view.copy() for view in views]
    spoilt[1][2, :-1] = views[1][2, 1:]  # a row shifted by a square
    spoilt[4] = views[4][:, ::-1]  # mirrored
    spoilt[6][0, :3] = views[6][1, :3]  # corners collapsed onto others
    spoilt[9] = np.roll(views[9].reshape(-1, 2), 1, axis=0).reshape(6, 9, 2)  # start swapped
    spoilt[12] += np.random.default_rng(1).normal(0.0, 15.0, (6, 9, 2))  # on other things
    return spoilt


@every_lens
@every_seed
def test_wrong_views_are_rejected_and_no_others(name: str, seed: int) -> None:
    """The lens comes out as it does from the ten right views, each wrong one with its reason."""
    lens, rng = LENSES[name], np.random.default_rng(seed)
    true = true_views(lens, rng)
    found = calibrate_lens_from_corners(_spoilt(noisy(true, rng)), BOARD, SIZE)
    reasons = dict(found.rejected)
    assert set(reasons) == {1, 4, 6, 9, 12}
    assert "8 of its 54 corners are not where the board has them" in reasons[1]
    assert reasons[4].startswith("mirrored")
    assert "3 of its 54 corners are not where the board has them" in reasons[6]
    assert all("does not fit the other views" in reasons[k] for k in (9, 12))
    assert (found.lens.model is LensModel.FISHEYE) == (name == "fisheye")
    off = np.abs(found.lens.parameters[:2] - lens.parameters[:2])
    assert (off < 4.0 * found.adjustment.posterior.lens_sigma[:2]).all()
    assert (off < 0.01 * lens.parameters[:2]).all()
    for k, pose in zip(found.used, found.adjustment.poses, strict=True):
        corners_px = found.lens.project(pose.apply(found.adjustment.corners_mm))
        assert np.hypot(*(corners_px - true[k].reshape(-1, 2)).T).mean() < 0.1


@every_lens
def test_right_views_are_all_kept(name: str) -> None:
    rng = np.random.default_rng(2)
    views = noisy(true_views(LENSES[name], rng), rng)
    found = calibrate_lens_from_corners(views, BOARD, SIZE)
    assert found.rejected == ()
    assert found.used == tuple(range(15))


def test_views_of_a_few_corners_or_none_are_left_out() -> None:
    """A finder that finds nothing gives None; corners that are NaN were not found."""
    rng = np.random.default_rng(2)
    views = noisy(true_views(LENSES["tangent"], rng, 8), rng)
    views[4][2:] = np.nan
    views[5].reshape(-1, 2)[:7] = np.nan
    views[6][:, :, 0] = np.nan
    found = calibrate_lens_from_corners([*views, None], BOARD, SIZE)
    missing = "0 corners of the board, 8 are needed"
    assert dict(found.rejected) == {6: missing, 8: missing}
    views[4][1:] = np.nan  # one row: on a line
    found = calibrate_lens_from_corners(views, BOARD, SIZE)
    assert {k for k, _ in found.rejected} == {4, 6}


@every_lens
def test_a_mirrored_image_is_told_from_a_turned_board(name: str) -> None:
    """Named as a finder does, which takes the board for one that is held otherwise."""
    lens, rng = LENSES[name], np.random.default_rng(4)
    index, covariance = np.arange(54), np.tile(0.01 * np.eye(2), (54, 1, 1))

    def mirrored(corners_px: FloatArray) -> bool:
        view = BoardView(index, corners_px.reshape(-1, 2), covariance)
        return looks_mirrored(view, lens, BOARD, BOARD.corners_mm, SIZE)

    for true in true_views(lens, rng, 4):
        seen = true + rng.normal(0.0, 0.003, true.shape)
        across, down = np.array(SIZE) - 1.0
        assert not mirrored(seen)
        assert not mirrored(seen[::-1, ::-1])
        assert mirrored(seen[:, ::-1] * [-1.0, 1.0] + [across, 0.0])
        assert mirrored(seen[::-1] * [1.0, -1.0] + [0.0, down])
        assert mirrored([across, down] - seen)


def test_two_views_are_refused() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(CalibrationError, match=r"lens: 2 views of the board given.*3 are needed"):
        calibrate_lens_from_corners(true_views(LENSES["tangent"], rng, 2), BOARD, SIZE)


def test_corners_of_another_board_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"view 0 has corners of shape \(40, 2\).*9x6"):
        calibrate_lens_from_corners([np.zeros((40, 2))], BOARD, SIZE)
