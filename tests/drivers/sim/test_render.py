"""The renderer is better than what it tests: edges, corners and discs lie right to 0.001 px.

Above all along image rows and columns, where anti-aliasing by samples would round an edge's place.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from core.checkerboard.board import Board
from core.checkerboard.corner_fit import locate_corners
from core.checkerboard.corners import predict_corners
from core.discs.disc_fit import locate_discs
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.site import CameraGeometry, CheckerboardTarget
from drivers.sim.geometry import TrueBoard, TrueLens
from drivers.sim.kernels import edge_share, wedge_share
from drivers.sim.render import CameraRenderer, Look
from drivers.sim.response import pixel_response
from drivers.sim.settings import Sensor, SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import CENTRES_MM, clean, site
from tests.exhaustive import one_of

WHITE, BLACK, PEDESTAL = 0.75, 0.05, 0.01
SENSOR = Sensor(bits=16, noise=False)
BROWN = np.array([-0.09, 0.02, 3e-4, -2e-4, -0.002])
LINES_MM = 2.0 * np.arange(23) + np.random.default_rng(7).normal(size=23) * 0.004
BOARD = TrueBoard(LINES_MM, LINES_MM[:20], 0.0)
TARGET = CheckerboardTarget(22, 19, 2.0, 50.0)


def _lens(camera: CameraGeometry, distortion: np.ndarray) -> TrueLens:
    return TrueLens(camera.focal_px, 1.0001 * camera.focal_px, *camera.centre_px, distortion)


def _turned(roll_deg: float, tilt_deg: tuple[float, float] = (0.0, 0.0)) -> Pose:
    """The board about 50 mm before the camera, turned about its middle, on no whole pixel."""
    R = Rotation.from_euler("zxy", [roll_deg, *tilt_deg], degrees=True).as_matrix()
    return Pose(R, np.array([0.137, -0.211, 50.0]) - R @ np.append(BOARD.size_mm / 2.0, 0.0))


def _sub_image(
    pose: Pose, lens: TrueLens, camera: CameraGeometry, blur_px: float, corner_blur: float
) -> np.ndarray:
    renderer = CameraRenderer(camera, lens, Look(blur_px, corner_blur, 0.0, 0.0), SENSOR)
    radiance = renderer.lit(renderer.board(pose, BOARD, WHITE, BLACK), 1.0)
    return renderer.expose(radiance, PEDESTAL, np.random.default_rng(0))


def _corner_errors(
    image: np.ndarray, lens: TrueLens, pose: Pose, board: TrueBoard, target: CheckerboardTarget
) -> tuple[np.ndarray, np.ndarray]:
    """Corners as the estimator locates them from the true prediction: index (n, 2), error px."""
    true = Lens(
        np.concatenate([[lens.fx_px, lens.fy_px, 0.0, lens.cx_px, lens.cy_px], lens.distortion])
    )
    inner = board.corners_mm()[1:-1, 1:-1]
    index, points, maps = predict_corners(
        true, pose, Board.nominal(target), inner.reshape(-1, 3), image.shape
    )
    fits = locate_corners(image, 65535.0, points, maps)
    assert fits.usable.all()
    return np.column_stack(np.divmod(index, inner.shape[1])), fits.points_px - points


def _line_means(line: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Mean error (2,) of each row or column of corners of which enough is in the image."""
    counts = np.bincount(line)
    return np.array([error[line == k].mean(axis=0) for k in np.nonzero(counts > 8)[0]])


def _edge_errors(image: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Errors of edges along each pixel row, found by area, without any model of an edge.

    Between the middles of two squares, the pixels' shares of white add up to an edge's position.
    Rows (line, error); corners: images of all line crossings.
    """
    rows, columns = corners.shape[:2]
    lines = [CubicSpline(corners[:, i, 1], corners[:, i, 0]) for i in range(columns)]
    errors = []
    for v in range(16, image.shape[0] - 16, 3):
        crossings = [float(line(v)) for line in lines]
        above = np.argmax(corners[:, :, 1] > v, axis=0)
        for i in range(1, columns - 1):
            nearest = np.abs(corners[:, i - 1 : i + 2, 1] - v).min()
            if above[i] in {0, rows} or nearest < 7.0 or not 30 < crossings[i] < len(image.T) - 30:
                continue
            first = round(0.5 * (crossings[i - 1] + crossings[i]))
            last = round(0.5 * (crossings[i] + crossings[i + 1]))
            cut = image[v, first : last + 1].astype(float)
            share = (cut - cut[-1]) / (cut[0] - cut[-1])
            errors.append((i, first - 0.5 + share.sum() - crossings[i]))
    return np.array(errors)


def _polygon(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centroid and area of a polygon (n, 2)."""
    following = np.roll(points, -1, axis=0)
    cross = points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]
    centroid = ((points + following) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    return centroid, abs(cross.sum()) / 2.0


# ------------------------------------------------------------------ positions


@pytest.mark.parametrize("roll_deg", [0.0, 0.02, 0.1, 0.5, 3.0, 20.0])
def test_corners_at_all_angles_are_where_they_should_be(roll_deg: float) -> None:
    """A lens of even blur: corners lie right within what the estimator can tell, row by row."""
    camera = CameraGeometry(800, 600, 5.86, 6.0)
    lens, pose = _lens(camera, np.zeros(5)), _turned(roll_deg)
    image = _sub_image(pose, lens, camera, 0.65, 1.0)
    index, error = _corner_errors(image, lens, pose, BOARD, TARGET)
    assert len(error) > 200
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.0003
    assert np.abs(error).max() < 0.001
    for axis in (0, 1):
        assert np.abs(_line_means(index[:, axis], error)).max() < 0.0005


@pytest.mark.parametrize("corner_blur", [1.0, 1.5])
@pytest.mark.parametrize(
    ("roll_deg", "tilt_deg", "distortion"),
    [
        (0.0, (0.0, 0.0), 0.0),
        (0.02, (0.0, 0.0), 0.0),
        (0.4, (0.0, 0.0), 0.0),
        (5.0, (0.0, 0.0), 0.0),
        (0.0, (0.0, 0.0), 1.0),
        (-6.0, (17.0, -14.0), 1.0),
    ],
)
def test_edges_at_all_angles_are_where_they_should_be(
    roll_deg: float, tilt_deg: tuple[float, float], distortion: float, corner_blur: float
) -> None:
    """Edges along rows and columns lie right by area: each within 0.001 px, no line shifted.

    So they do where the blur grows across the image.
    """
    camera = CameraGeometry(800, 600, 5.86, 6.0)
    lens, pose = _lens(camera, BROWN * distortion), _turned(roll_deg, tilt_deg)
    image = _sub_image(pose, lens, camera, 0.65, corner_blur)
    crossings = lens.project(pose.apply(BOARD.corners_mm().reshape(-1, 3))).reshape(20, 23, 2)
    for errors in (
        _edge_errors(image, crossings),
        _edge_errors(image.T, crossings.transpose(1, 0, 2)[..., ::-1]),
    ):
        assert len(errors) > 800
        assert np.abs(errors[:, 1]).max() < 0.001
        lines = [errors[errors[:, 0] == i, 1].mean() for i in np.unique(errors[:, 0])]
        assert np.abs(lines).max() < 0.0005


@pytest.mark.parametrize(("corner_blur", "limit_px"), [(1.0, 0.0005), (1.5, 0.002)])
@pytest.mark.parametrize("seed", [1, 3][:: one_of(2)])
def test_corners_of_a_whole_world_are_where_truth_says(
    seed: int, corner_blur: float, limit_px: float
) -> None:
    """Full-size images with all that a rig departs from its drawing; rms, and each row's mean.

    Blur that grows within a corner's window is no part of the estimator's model: in images without
    noise it then fades out pixels that it cannot explain, hence the wider limit.
    """
    optics = replace(clean().optics, corner_blur=corner_blur)
    world = World(site(shrink=1), clean(seed=seed, optics=optics))
    true, target = world.geometry, world.site.sub_target
    image = world.render("sub", SimSettings().start_utc)
    index, error = _corner_errors(image, true.sub, true.T_CS_WS, true.board, target)
    assert len(error) > 800
    assert np.sqrt((error**2).mean(axis=0)).max() < limit_px
    assert np.abs(_line_means(index[:, 0], error)).max() < limit_px


@pytest.mark.parametrize("shrink", [1, 2, 4])
def test_discs_are_where_they_should_be(shrink: int) -> None:
    """Discs of 12 to 50 px radius: centroid, fitted centre and area are those of the outline."""
    camera = CameraGeometry(1920 // shrink, 1200 // shrink, 5.86 * shrink, 800.0)
    discs = np.column_stack([CENTRES_MM, np.full(5, 4.0)])
    lens = _lens(camera, np.zeros(5))
    turn = Rotation.from_rotvec([0.02, -0.015, 0.01]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    pose = Pose(turn, np.array([0.31, -0.17, 11000.0]))
    renderer = CameraRenderer(camera, lens, Look(0.75, 1.0, 0.0, 0.0), SENSOR)
    greys = np.array([0.73, 0.03, 0.28])
    plate = np.array([-29.0, -25.0, 29.0, 25.0])
    radiance = renderer.lit(renderer.discs(pose, discs, plate, greys), 1.0)
    image = renderer.expose(radiance, PEDESTAL, np.random.default_rng(0))
    turns = np.linspace(0.0, math.tau, 3600, endpoint=False)
    radius_px = 4.0 * camera.focal_px / 11000.0
    centres = []
    for x, y, radius in discs:
        edge = np.stack([x + radius * np.cos(turns), y + radius * np.sin(turns), 0.0 * turns], 1)
        centre, area = _polygon(lens.project(pose.apply(edge)))
        centres.append(centre)
        u, v = np.rint(centre).astype(int)
        half = round(radius_px + 6.0)
        weight = image[v - half : v + half + 1, u - half : u + half + 1].astype(float)
        weight -= weight[0, 0]
        axis = np.arange(-half, half + 1)
        moment = np.array([axis @ weight.sum(0), axis @ weight.sum(1)]) / weight.sum()
        assert moment == pytest.approx(centre - [u, v], abs=0.0005)
        share = weight.sum() / (0.70 * 65535.0 * area)
        assert radius_px * math.sqrt(share) == pytest.approx(radius_px, abs=0.001)
    fits = locate_discs(
        image, 65535.0, np.array(centres), np.tile(radius_px * np.eye(2), (5, 1, 1))
    )
    assert fits.points_px == pytest.approx(np.array(centres), abs=0.0005)


# ------------------------------------------------------------------ grey values


def test_shares_of_the_four_wedges_add_up() -> None:
    """What two edges cut a pixel into adds up to what each cuts off, at whatever angle.

    Along rows and columns the share of a wedge is the product of its edges' shares.
    """
    rng = np.random.default_rng(2)
    for blur_px in (0.5, 0.65, 1.1):
        response = pixel_response(blur_px)
        for _ in range(200):
            turns = rng.uniform(0.0, math.tau) + np.array([0.0, rng.uniform(1.1, 2.0)])
            scales, at = rng.uniform(0.2, 3.0, 2), rng.uniform(-4.0, 4.0, 2)
            normals = scales[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
            a, b = (tuple(float(e) for e in (-n @ at, *n)) for n in normals)
            minus_b = tuple(-e for e in b)
            both = wedge_share(response, a, b) + wedge_share(response, a, minus_b)
            assert both == pytest.approx(edge_share(response, a), abs=2e-4)
            assert wedge_share(response, b, a) == pytest.approx(wedge_share(response, a, b))
            a, b = (float(at[0]), float(scales[0]), 0.0), (float(at[1]), 0.0, -float(scales[1]))
            product = edge_share(response, a) * edge_share(response, b)
            assert wedge_share(response, a, b) == pytest.approx(product, abs=5e-5)


@pytest.mark.parametrize("roll_deg", [6.0, 25.0, 137.0][:: one_of(2)])
@pytest.mark.parametrize("blur_px", [0.5, 0.65, 1.1][:: one_of(2)])
def test_pixels_are_means_of_a_dense_scene(roll_deg: float, blur_px: float) -> None:
    """A board's corner, its border and its squares, seen askew: as from 24 x 24 points a pixel."""
    dense, width, height, margin = 24, 56, 48, 8
    focal_px = 250.0
    lens = TrueLens(focal_px, focal_px, 24.2, 21.7, np.zeros(5))
    R = Rotation.from_euler("zxy", [roll_deg, 20.0, -15.0], degrees=True).as_matrix()
    pose = Pose(R, np.array([0.3, 0.1, 50.0]) - R @ np.array([1.1, 1.3, 0.0]))
    camera = CameraGeometry(width, height, 5.86, focal_px * 0.00586)
    image = _sub_image(pose, lens, camera, blur_px, 1.0) / 65535.0 - PEDESTAL

    v, u = np.mgrid[-margin * dense : (height + margin) * dense, : (width + 2 * margin) * dense]
    u = (u + 0.5) / dense - 0.5 - margin
    v = (v + 0.5) / dense - 0.5
    rays = np.stack([(u - lens.cx_px) / focal_px, (v - lens.cy_px) / focal_px, np.ones_like(u)], -1)
    away, rays = pose.inverse().t_mm, rays @ pose.R  # rows: R^T ray
    x = away[0] - away[2] * rays[..., 0] / rays[..., 2]
    y = away[1] - away[2] * rays[..., 1] / rays[..., 2]
    i, j = np.searchsorted(BOARD.x_lines_mm, x), np.searchsorted(BOARD.y_lines_mm, y)
    black = (i > 0) & (j > 0) & ((i + j) % 2 == 0)
    scene = gaussian_filter(np.where(black, BLACK, WHITE), blur_px * dense, truncate=5.0)
    means = scene.reshape(height + 2 * margin, dense, width + 2 * margin, dense).mean((1, 3))
    expected = means[margin:-margin, margin:-margin]
    assert expected.std() > 0.1
    assert np.abs(image - expected).max() < 0.003
    assert np.sqrt(((image - expected) ** 2).mean()) < 0.0006


@pytest.mark.parametrize(("blur_px", "corner_blur"), [(0.5, 1.2), (0.65, 1.5), (0.75, 1.0)])
def test_blur_is_as_set(blur_px: float, corner_blur: float) -> None:
    """The variance of an edge's profile is the lens's and the pixel's, in the centre and far out.

    It grows with the square of the distance to the centre.
    """
    camera = CameraGeometry(800, 600, 5.86, 6.0)
    lens, pose = _lens(camera, np.zeros(5)), _turned(0.0)
    image = _sub_image(pose, lens, camera, blur_px, corner_blur).astype(float)
    crossings = lens.project(pose.apply(BOARD.corners_mm().reshape(-1, 3))).reshape(20, 23, 2)
    for j, i in ((10, 11), (9, 3), (16, 18)):
        at_u, v = crossings[j, i, 0], round(crossings[j : j + 2, i, 1].mean())
        first = round(at_u) - 12
        slope = np.diff(image[v, first : first + 25])
        apart = first + 0.5 + np.arange(24) - at_u
        variance = (slope @ apart**2) / slope.sum() - 2.0 / 12.0  # the pixel and the difference
        out2 = ((at_u - 399.5) ** 2 + (v - 299.5) ** 2) / (404.0**2 + 304.0**2)
        expected = blur_px**2 * (1.0 + (corner_blur**2 - 1.0) * out2)
        assert variance == pytest.approx(expected, abs=0.003)
