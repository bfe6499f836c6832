"""The board is found without a guess, its corners rightly named, located to their own sigma."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from core.checkerboard import corners
from core.checkerboard.corners import LocatedBoard, detect_board, locate_board, refine_board
from core.checkerboard.resection import resect
from core.errors import TargetNotFoundError
from core.geometry.pose import Pose
from core.images import GreyImage
from core.site import CheckerboardTarget
from drivers.sim.render import Look
from drivers.sim.settings import Sensor
from tests.core.boards import AS_CORE, CAMERA, EVEN, TARGET, BoardScene
from tests.exhaustive import one_of

FAR = (1.0, -0.5, 62.0)
"""The whole board in the image when it is tilted or rolled."""
SADDLE_MARGIN_PX = 10.0
"""Corners nearer to the border are found from the prediction only."""
NO_BORDER = CheckerboardTarget(40, 31, 2.0, 50.0)
"""So large that the image shows none of its borders."""


def _assert_right(scene: BoardScene, seen: LocatedBoard, within_px: float = 0.15) -> None:
    """Every corner is where the truth puts the corner of this index, and none is missing."""
    miss = seen.view.points_px - scene.corners_px[seen.view.index]
    assert np.hypot(miss[:, 0], miss[:, 1]).max() < within_px
    assert set(scene.inside(SADDLE_MARGIN_PX)) <= set(seen.view.index)


# ------------------------------------------------------------------ found and named


@pytest.mark.parametrize(
    "turn_deg",
    [
        (25.0, 0.0, 0.0),
        (-25.0, 0.0, 0.0),
        (0.0, 25.0, 0.0),
        (17.0, -17.0, 0.0),
        (0.0, 0.0, 20.0),
        (0.0, 0.0, -40.0),
        (15.0, -12.0, 30.0),
    ],
)
def test_found_tilted_and_rolled(turn_deg) -> None:
    """Tilts to 25 degrees and rolls to 40 need no guess."""
    scene = BoardScene(turn_deg=turn_deg, middle_mm=FAR)
    seen = detect_board(scene.image(), scene.board)
    _assert_right(scene, seen)
    assert seen.unambiguous
    assert seen.visible == len(seen.view.index)


@pytest.mark.parametrize("quarter_deg", [90.0, 180.0, -90.0])
def test_found_however_the_board_is_turned(quarter_deg) -> None:
    """The colour of the corner square and the count of squares tell which way the board is up."""
    scene = BoardScene(turn_deg=(0.0, 0.0, quarter_deg + 5.0), middle_mm=(0.0, 0.0, 82.0))
    seen = detect_board(scene.image(), scene.board)
    miss = seen.view.points_px - scene.corners_px[seen.view.index]
    assert np.abs(miss).max() < 0.15
    assert seen.unambiguous
    assert len(seen.view.index) > 0.9 * len(scene.corners_px)


@pytest.mark.parametrize("moved_mm", [(12.0, 6.0), (-12.0, 6.0), (12.0, -6.0), (-20.0, -9.0)])
def test_partly_outside_the_image_is_named_by_its_border(moved_mm) -> None:
    """A board cut off by two sides of the image: the two borders seen name its corners."""
    scene = BoardScene().moved(*moved_mm)
    seen = detect_board(scene.image(), scene.board)
    assert len(seen.view.index) < 0.7 * len(scene.corners_px)
    _assert_right(scene, seen)
    assert seen.unambiguous


@pytest.mark.parametrize("moved_mm", [-1.3, 1.3])
def test_parity_tells_which_column_is_missing(moved_mm) -> None:
    """No border at left or right, one column outside: the squares' colours say which."""
    scene = BoardScene(target=CheckerboardTarget(25, 15, 2.0, 50.0)).moved(moved_mm, 0.0)
    seen = detect_board(scene.image(), scene.board)
    assert len({*(seen.view.index % 24)}) == 23
    _assert_right(scene, seen)
    assert seen.unambiguous


@pytest.mark.parametrize(
    "look", [Look(0.65, 1.5, 0.45, 1.0), Look(0.65, 1.5, 0.9, 4.0), Look(1.8, 1.3, 0.3, 0.0)]
)
@pytest.mark.parametrize("light", [1.0, 0.1])
def test_found_in_uneven_and_weak_light(look, light) -> None:
    """A corner at a tenth of the light, a dim image, a blurred one."""
    scene = BoardScene(turn_deg=(5.0, 3.0, -2.0), look=look, light=light)
    seen = detect_board(scene.image(), scene.board)
    _assert_right(scene, seen, within_px=0.3)
    assert seen.unambiguous


def test_an_overexposed_board_is_still_right() -> None:
    """White squares in saturation: the edges' dark halves are left, and name and place hold."""
    scene = BoardScene(light=1.5)
    assert np.mean(scene.image().pixels == 255) > 0.3
    seen = locate_board(scene.image(), AS_CORE, scene.board, scene.board.corners_mm, scene.pose)
    miss = seen.view.points_px - scene.corners_px[seen.view.index]
    assert np.abs(miss).max() < 0.1
    assert len(miss) > 0.95 * len(scene.corners_px)


@pytest.mark.parametrize("length_px", [60.0, 150.0])
def test_an_insect_hides_only_what_is_under_it(length_px) -> None:
    """The other corners are found and named as before, and the pose is not moved."""
    free = BoardScene(turn_deg=(4.0, 3.0, 2.0))
    scene = BoardScene(turn_deg=(4.0, 3.0, 2.0), insect_px=(250.0, 140.0, length_px))
    nominal = scene.board.corners_mm
    seen = locate_board(scene.image(), AS_CORE, scene.board, nominal, scene.pose)
    missing = np.setdiff1d(scene.inside(SADDLE_MARGIN_PX), seen.view.index)
    assert len(missing) >= 2
    away = np.hypot(*(scene.corners_px[missing] - [250.0, 140.0]).T)
    assert away.max() < 0.75 * length_px
    poses = [
        resect(AS_CORE, nominal, view).pose
        for view in (
            seen.view,
            locate_board(free.image(), AS_CORE, free.board, nominal, free.pose).view,
        )
    ]
    turned_rad = poses[0].compose(poses[1].inverse()).rotation_rad
    assert np.abs(turned_rad).max() < 1e-4


# ------------------------------------------------------------------ periodic, and not sure


def test_without_border_or_prediction_it_is_not_certain() -> None:
    """A lattice that could be several parts of the board is said to be so."""
    scene = BoardScene(target=NO_BORDER)
    assert not detect_board(scene.image(), scene.board).unambiguous


@pytest.mark.parametrize("moved_mm", [(0.0, 0.0), (0.7, -0.6)])
def test_a_prediction_names_what_no_border_does(moved_mm) -> None:
    """From a pose less than a square away the corners are the right ones, and certainly."""
    scene = BoardScene(target=NO_BORDER).moved(*moved_mm)
    expected = BoardScene(target=NO_BORDER).pose
    seen = locate_board(scene.image(), AS_CORE, scene.board, scene.board.corners_mm, expected)
    _assert_right(scene, seen, within_px=0.05)
    assert seen.unambiguous


def test_halfway_between_two_places_is_not_certain() -> None:
    """Moved a square in both directions, half the way to a place that looks alike: no guess."""
    scene = BoardScene(target=NO_BORDER).moved(1.0, 1.0)
    expected = BoardScene(target=NO_BORDER).pose
    seen = locate_board(scene.image(), AS_CORE, scene.board, scene.board.corners_mm, expected)
    assert not seen.unambiguous


@pytest.mark.parametrize("moved_mm", [(4.0, 0.0), (2.0, 2.0), (-4.0, 0.0)])
def test_a_whole_period_is_seen_by_the_border(moved_mm) -> None:
    """The board moved by whole periods against the prediction: its border tells."""
    still = BoardScene()
    scene = still.moved(*moved_mm)
    nominal = scene.board.corners_mm
    seen = locate_board(scene.image(), AS_CORE, scene.board, nominal, still.pose)
    assert seen.unambiguous
    moved = resect(AS_CORE, nominal, seen.view).pose.compose(still.pose.inverse())
    assert moved.t_mm[:2] == pytest.approx(moved_mm, abs=0.02)


# ------------------------------------------------------------------ not there


def _blank(rng: np.random.Generator) -> np.ndarray:
    return np.full((300, 480), 128)


def _black(rng: np.random.Generator) -> np.ndarray:
    return np.zeros((300, 480))


def _noise(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0, 255, (300, 480))


def _stripes(rng: np.random.Generator) -> np.ndarray:
    return np.broadcast_to(128 + 100 * np.sign(np.sin(np.arange(480) / 6.0)), (300, 480))


def _half_black(rng: np.random.Generator) -> np.ndarray:
    return np.where(np.arange(480) < 240, 0, 200) + np.zeros((300, 1))


def _spots(rng: np.random.Generator) -> np.ndarray:
    image = np.full((300, 480), 30.0)
    for u, v in rng.uniform(20, 280, (60, 2)):
        image[int(v) - 4 : int(v) + 4, int(u) - 4 : int(u) + 4] = 220
    return image


def _wrong_board(rng: np.random.Generator) -> np.ndarray:
    board = CheckerboardTarget(28, 20, 1.5, 50.0)
    return BoardScene(target=board, middle_mm=(0.0, 0.0, 55.0)).image().pixels


@pytest.mark.parametrize(
    "make", [_blank, _black, _noise, _stripes, _half_black, _spots, _wrong_board]
)
def test_an_image_without_the_board_says_so(make: Callable) -> None:
    """An error of one line rather than corners of something else."""
    pixels = np.asarray(make(np.random.default_rng(3)), dtype=np.uint8)
    with pytest.raises(TargetNotFoundError, match=r"^(no checkerboard|sub target): [^\n]+$"):
        detect_board(GreyImage(pixels), BoardScene().board)


def test_a_prediction_beside_the_image_says_so() -> None:
    away = Pose(np.eye(3), np.array([500.0, 0.0, 50.0]))
    scene = BoardScene()
    with pytest.raises(TargetNotFoundError, match="predicted pose"):
        refine_board(scene.image(), AS_CORE, away, scene.board, scene.board.corners_mm)


@pytest.mark.parametrize("shift_mm", np.arange(0.0, 5.0, 0.5)[:: one_of(2)])
def test_a_line_near_the_edge_of_the_image_is_not_taken_for_the_last(
    shift_mm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Squares of 50 px, found in an image of a quarter of the size, blind for corners at its edge.

    Whichever line is just inside, the corners are named rightly and without a doubt.
    """
    monkeypatch.setattr(corners, "_MOST", 0.0)  # large images have most corners off the edge
    wide = BoardScene(CheckerboardTarget(17, 16, 5.0, 52.0), turn_deg=(2.0, -1.5, 1.0))
    scene = wide.moved(shift_mm, 0.6 * shift_mm)
    nominal = scene.board.corners_mm
    near = scene.moved(0.3, -0.4).pose
    seen = locate_board(scene.image(), AS_CORE, scene.board, nominal, near)
    assert seen.unambiguous
    off_px = np.hypot(*(seen.view.points_px - scene.corners_px[seen.view.index]).T)
    assert off_px.max() < 0.3


# ------------------------------------------------------------------ how well


@pytest.mark.parametrize(
    ("light", "bits", "sigma_px"), [(1.0, 8, 0.004), (0.15, 8, 0.012), (1.0, 12, 0.004)]
)
def test_located_to_their_own_sigma(light, bits, sigma_px) -> None:
    """Twenty noises over one scene: the scatter is what each corner's covariance says.

    The mean is the truth, to a hundredth of a pixel at worst.
    """
    scene = BoardScene(turn_deg=(8.0, -6.0, 4.0), light=light, sensor=Sensor(bits=bits))
    nominal = scene.board.corners_mm
    views = [
        refine_board(image, AS_CORE, scene.pose, scene.board, nominal).view
        for image in scene.images(20)
    ]
    assert all(len(view.index) == len(views[0].index) for view in views)
    points = np.stack([view.points_px for view in views])
    covariance = np.stack([view.covariance_px2 for view in views])
    away = points - points.mean(axis=0)
    squares = np.einsum("kni,knij,knj->kn", away, np.linalg.inv(covariance), away)
    assert 0.6 < np.sqrt(squares.mean() / 2.0 * 20 / 19) < 1.1
    assert np.sqrt(np.median(covariance[..., 0, 0])) < sigma_px
    bias_px = points.mean(axis=0) - scene.corners_px[views[0].index]
    assert np.sqrt((bias_px**2).mean()) < 0.005
    assert np.abs(bias_px).max() < 0.02


LARGE = CheckerboardTarget(13, 12, 5.0, 52.0)
"""Squares of 50 px, in even light: fitted with the light of the squares around."""


@pytest.mark.parametrize(("light", "bits"), [(1.0, 8), (0.1, 8), (1.0, 16)])
@pytest.mark.parametrize("look", [EVEN, Look(0.65, 1.5, 0.45, 1.0)], ids=["even", "uneven"])
def test_corners_of_large_squares_scatter_by_their_own_sigma(look, light, bits) -> None:
    """Ten noises, each seen from a prediction 0.6 px off: no gain is known, nor the light.

    Scatter and bias about the truth are what the covariance says.
    """
    scene = BoardScene(
        LARGE, turn_deg=(8.0, -6.0, 4.0), light=light, look=look, sensor=Sensor(bits=bits)
    )
    nominal, near = scene.board.corners_mm, scene.moved(0.06, -0.01).pose
    squares = []
    for image in scene.images(10):
        view = refine_board(image, AS_CORE, near, scene.board, nominal).view
        assert len(view.index) > 0.97 * len(scene.inside(3.0))
        away = view.points_px - scene.corners_px[view.index]
        squares.append(np.einsum("ni,nij,nj->n", away, np.linalg.inv(view.covariance_px2), away))
    assert 0.8 < np.sqrt(np.concatenate(squares).mean() / 2.0) < 1.25


def test_white_may_be_noisier_than_black() -> None:
    """Shot noise: sigma follows what each pixel knows, and the pose is better for it.

    The same noise all over, as strong as in white, costs a quarter at least.
    """
    scene = BoardScene(LARGE, turn_deg=(8.0, -6.0, 4.0), sensor=Sensor(bits=16))
    nominal, rng = scene.board.corners_mm, np.random.default_rng(4)
    clean = replace(scene, sensor=Sensor(bits=16, noise=False)).image().pixels.astype(float)
    white = np.percentile(clean, 90.0)
    sigma_px = []
    for grey in (clean, np.full_like(clean, white)):
        noisy = clean + rng.normal(size=clean.shape) * 400.0 * np.sqrt(grey / white)
        image = GreyImage(noisy.clip(0, 65535).astype(np.uint16), 16)
        view = refine_board(image, AS_CORE, scene.pose, scene.board, nominal).view
        sigma_px.append(np.sqrt(np.median(view.covariance_px2[:, 0, 0])))
    assert sigma_px[1] > 1.25 * sigma_px[0]


def test_pose_to_its_own_sigma() -> None:
    """The scatter of the pose over twenty noises is what its covariance says; the mean is true."""
    scene = BoardScene(turn_deg=(8.0, -6.0, 4.0))
    nominal = scene.board.corners_mm
    fits = [
        resect(
            AS_CORE, nominal, locate_board(image, AS_CORE, scene.board, nominal, scene.pose).view
        )
        for image in scene.images(20, seed=9)
    ]
    steps = np.array(
        [
            [
                *fit.pose.compose(scene.pose.inverse()).rotation_rad,
                *(fit.pose.t_mm - scene.pose.t_mm),
            ]
            for fit in fits
        ]
    )
    sigma = np.sqrt(np.mean([np.diag(fit.covariance) for fit in fits], axis=0))
    scatter = steps.std(axis=0, ddof=1) / sigma
    assert np.all((scatter > 0.35) & (scatter < 1.2))
    assert np.abs(steps[:, :3].mean(axis=0)).max() < 2e-5
    assert sigma[:3].max() < 2.5e-5


def test_places_are_the_same_with_the_lens_as_without() -> None:
    """`detect_board` knows no lens, `refine_board` does: they agree to a twentieth of a pixel."""
    scene = BoardScene(target=TARGET, turn_deg=(3.0, -8.0, 1.0))
    image = scene.image()
    without = detect_board(image, scene.board).view
    refined = refine_board(image, AS_CORE, scene.pose, scene.board, scene.board.corners_mm).view
    _, a, b = np.intersect1d(without.index, refined.index, return_indices=True)
    assert len(a) > 0.95 * len(without.index)
    assert np.abs(without.points_px[a] - refined.points_px[b]).max() < 0.06
    assert refined.points_px[:, 0].max() < CAMERA.width_px
