"""The simulated world keeps the conventions, and its images show what its truth says."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import cv2
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from drivers.sim.settings import Motion, Scenario, SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import AS_DRAWN, clean, disc_centroids, site

START = SimSettings().start_utc
LATER = START + timedelta(hours=5)


def _matrix(pose) -> np.ndarray:
    return np.vstack([np.column_stack([pose.R, pose.t_mm]), [0.0, 0.0, 0.0, 1.0]])


def _cv_project(points_mm: np.ndarray, lens) -> np.ndarray:
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    zero = np.zeros(3)
    return cv2.projectPoints(points_mm, zero, zero, K, lens.distortion)[0].reshape(-1, 2)


# ------------------------------------------------------------------ conventions


def test_up_is_up_and_right_is_right() -> None:
    """A bridge that goes up and right goes up and right in the main image, by f/Z px per mm."""
    settings = clean(as_built=AS_DRAWN, scenarios=(Scenario("bridge"),))
    world = World(site(), settings)
    shift_px = world.disc_centres_px(LATER) - world.disc_centres_px(START)
    truth = world.truth(LATER)
    assert truth.displacement_mm[1] > 1.0
    px_per_mm = world.site.main.focal_px / 11000.0
    assert shift_px == pytest.approx(
        np.tile(truth.displacement_mm * [1.0, -1.0] * px_per_mm, (5, 1)), abs=1e-9
    )
    assert truth.false_mm == pytest.approx([0.0, 0.0], abs=1e-12)


def test_ws_origin_is_top_left_and_black() -> None:
    """The board's first corner is the top-left one in the sub image; the square at it is black."""
    world = World(site(sub_target=replace(site().sub_target, squares_y=21)), clean())
    corners = world.board_corners_px(START)
    assert corners[0, 0, 0] < corners[0, -1, 0]
    assert corners[0, 0, 1] < corners[-1, 0, 1]
    image = world.render("sub", START)
    first = np.rint(corners[:2, :2].mean(axis=(0, 1))).astype(int)
    second = np.rint(corners[:2, 1:3].mean(axis=(0, 1))).astype(int)
    assert image[first[1], first[0]] < 0.3 * image[second[1], second[0]]


def test_nodding_up_lowers_the_target() -> None:
    """With the rig as drawn, a turn of the sub-camera by +1 mrad about x is 11 mm of false y.

    The main camera looks back along -z of CS: turned by R = I + [rx]x, T_CSj_CS1 takes the far
    target (0, 0, -Z) to (0, rx Z, -Z), down in CS and, y down there too, down in the main image.
    """
    world = World(site(), clean(as_built=AS_DRAWN, scenarios=()))
    world.turn_head(0.0, np.degrees(-1e-3))
    truth = world.truth(START)
    assert truth.motion.rotation_rad == pytest.approx([1e-3, 0.0, 0.0], abs=1e-4)
    assert truth.false_mm[1] == pytest.approx(-11.0, abs=0.2)
    assert world.disc_centres_px(START)[2, 1] > (world.site.main.height_px - 1) / 2.0


@pytest.mark.parametrize("distance_mm", [11000.0, 22000.0])
def test_chain_of_frames(distance_mm: float) -> None:
    """Both cameras see the targets through the chain of frames of method.md, OpenCV projecting."""
    world = World(site(distance_mm=distance_mm), clean())
    world.turn_head(0.1, -0.05)
    truth, true = world.truth(LATER), world.geometry
    M = _matrix(truth.motion)
    d = np.append(truth.displacement_mm, 0.0)
    centres = np.column_stack([world.site.main_target.centres_mm, np.zeros(5)])
    target_CM1 = (centres + d) @ true.T_CM_WM.R.T + true.T_CM_WM.t_mm
    chain = _matrix(true.T_CM_CS) @ M @ np.linalg.inv(_matrix(true.T_CM_CS))
    target_CMj = target_CM1 @ chain[:3, :3].T + chain[:3, 3]
    assert world.disc_centres_px(LATER) == pytest.approx(
        _cv_project(target_CMj, true.main), abs=1e-6
    )
    board_CSj = M @ _matrix(true.T_CS_WS)
    corners = true.board.corners_mm().reshape(-1, 3) @ board_CSj[:3, :3].T + board_CSj[:3, 3]
    assert world.board_corners_px(LATER).reshape(-1, 2) == pytest.approx(
        _cv_project(corners, true.sub), abs=1e-6
    )


def test_raw_is_true_plus_false() -> None:
    """The image shift is B~ (d + false), Eq. 15, but for second-order terms of the motion."""
    world = World(site(), clean(motion=Motion(ramp_min=1.0)))
    true, scale = world.geometry, world.geometry.main.fx_px / world.geometry.T_CM_WM.t_mm[2]
    B = scale * true.T_CM_WM.R[:2, :2]
    for hours in (1.0, 4.0, 9.0, 17.0):
        t_utc = START + timedelta(hours=hours)
        truth = world.truth(t_utc)
        assert np.linalg.norm(truth.false_mm) > 1.0
        shift_px = (world.disc_centres_px(t_utc) - world.disc_centres_px(START))[2]
        raw_mm = np.linalg.solve(B, shift_px)
        assert raw_mm == pytest.approx(truth.displacement_mm + truth.false_mm, abs=0.02)


def test_truth_from_another_reference() -> None:
    """Seen from a reference within the drift, the truth at that reference is zero, then the change.

    T_CSj_CS1 = T_CSj_CS0 inv(T_CS1_CS0).
    """
    world = World(site(), clean())
    reference = START + timedelta(hours=2)
    zero = world.truth(reference, reference)
    assert zero.displacement_mm == pytest.approx([0.0, 0.0], abs=1e-12)
    assert zero.false_mm == pytest.approx([0.0, 0.0], abs=1e-9)
    assert zero.motion.vector == pytest.approx(np.zeros(6), abs=1e-12)
    chain = world.truth(LATER, reference).motion.compose(world.truth(reference).motion)
    assert chain.vector == pytest.approx(world.truth(LATER).motion.vector, abs=1e-12)


# ------------------------------------------------------------------ images show the truth


def testdisc_centroids_are_where_truth_says() -> None:
    """Rendered discs of a moved bridge and rig lie within 0.001 px of their projected centres."""
    world = World(site(shrink=2), clean())
    true_px = world.disc_centres_px(LATER)
    image = world.render("main", LATER)
    radius_px = 4.0 * world.site.main.focal_px / 11000.0
    assert disc_centroids(image, true_px, radius_px) == pytest.approx(true_px, abs=0.001)


@pytest.mark.parametrize("axis", [0, 1], ids=["vertical lines", "horizontal lines"])
def test_board_edges_are_where_truth_says(axis: int) -> None:
    """Rendered edges lie where the projected lines cross a pixel row, lens, bow and print in.

    The edge in a row is found by area, without any model of an edge: between the middles of two
    squares, the pixels' shares of white add up to its position.
    """
    world = World(site(shrink=1), clean(seed=3))
    image, corners = world.render("sub", LATER).astype(float), world.board_corners_px(LATER)
    if axis == 1:  # the same with x and y exchanged
        image, corners = image.T, corners.transpose(1, 0, 2)[..., ::-1]
    rows, columns = corners.shape[:2]
    lines = [CubicSpline(corners[:, i, 1], corners[:, i, 0]) for i in range(columns)]
    errors = []
    for v in range(20, image.shape[0] - 20, 7):
        crossings = [float(line(v)) for line in lines]
        above = np.argmax(corners[:, :, 1] > v, axis=0)
        for i in range(1, columns - 1):
            nearest = np.abs(corners[:, i - 1 : i + 2, 1] - v).min()
            if above[i] in {0, rows} or nearest < 6.0 or not 30 < crossings[i] < len(image.T) - 30:
                continue
            first = round(0.5 * (crossings[i - 1] + crossings[i]))
            last = round(0.5 * (crossings[i] + crossings[i + 1]))
            cut = image[v, first : last + 1]
            share = (cut - cut[-1]) / (cut[0] - cut[-1])
            errors.append(first - 0.5 + share.sum() - crossings[i])
    assert len(errors) > 1500
    assert abs(np.mean(errors)) < 0.0001
    assert np.std(errors) < 0.0005


def test_board_corners_are_where_truth_says() -> None:
    """OpenCV's corner refinement, blind to our models, lands on the projected corners."""
    world = World(site(shrink=1), clean(seed=5))
    image = (world.render("sub", START) // 256).astype(np.uint8)
    inner = world.board_corners_px(START)[1:-1, 1:-1].reshape(-1, 2)
    inside = np.all((inner > 20) & (inner < np.array(image.shape[::-1]) - 20), axis=1)
    start = inner[inside].astype(np.float32)[:, None]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    found = cv2.cornerSubPix(image, start.copy(), (7, 7), (-1, -1), stop)[:, 0]
    error = found - inner[inside]
    assert len(error) > 700
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert np.sqrt((error**2).mean()) < 0.035  # its own, known limit: 0.027 here


# ------------------------------------------------------------------ as built, at rest, repeatable


def test_departures_stay_within_what_the_surveyor_said() -> None:
    """Rig, depth and print differ from the drawing, within 1.5 of their sigmas; seeds differ."""
    seen = set()
    for seed in range(12):
        world = World(site(shrink=24), clean(seed=seed))
        true, prior = world.geometry, world.site.rig
        drawn = Rotation.from_euler("xyz", prior.rotation_main_sub_deg, degrees=True).as_matrix()
        turn = Rotation.from_matrix(true.T_CM_CS.R @ drawn.T).as_rotvec(degrees=True)
        assert np.abs(turn).max() <= 1.5 * prior.rotation_sigma_deg + 1e-9
        assert np.abs(true.T_CM_CS.t_mm - prior.offset_main_sub_mm).max() <= 4.5 + 1e-9
        assert abs(true.T_CM_WM.t_mm[2] - 11000.0) <= 30.0 + 1e-9
        assert abs(true.board.size_mm[0] / 64.0 - 1.0) < 0.0015
        seen.add(float(true.T_CM_WM.t_mm[2]))
    assert len(seen) > 6


def test_everything_rests_before_the_start_and_moves_after() -> None:
    """Calibration happens before `start_utc`: no drift, no bridge; after it both within bounds."""
    world = World(site(shrink=24), clean())
    still = world.truth(START - timedelta(minutes=30))
    assert np.abs(still.motion.vector).max() < 1e-12
    assert np.all(still.displacement_mm == 0.0)
    motion = world.settings.motion
    vectors, last = [], None
    for minute in range(0, 1440, 5):
        truth = world.truth(START + timedelta(minutes=minute))
        vectors.append(truth.motion.vector)
        if last is not None:
            assert np.linalg.norm(truth.displacement_mm - last) < 1.0
        last = truth.displacement_mm
    peak = np.abs(vectors).max(axis=0)
    assert np.all(peak <= np.repeat([motion.drift_mrad / 1000.0, motion.drift_mm], 3))
    assert np.all(peak >= 0.2 * np.repeat([motion.drift_mrad / 1000.0, motion.drift_mm], 3))


def test_a_slab_is_cast_and_creeps() -> None:
    """The bridge's own course: straight between its points, level outside, switched by nothing."""
    course = ((10.0, 0.0), (20.0, -6.5), (120.0, -14.5))
    still = clean(scenarios=(), motion=Motion(bridge_course=course))
    world = World(site(shrink=24), still)
    down_mm = [
        world.truth(START + timedelta(minutes=minute)).displacement_mm
        for minute in (0, 10, 15, 20, 70, 120, 500)
    ]
    expected_mm = [0.0, 0.0, -3.25, -6.5, -10.5, -14.5, -14.5]
    np.testing.assert_allclose(down_mm, [[0.0, mm] for mm in expected_mm], atol=1e-9)


def test_motion_is_smooth() -> None:
    """Between frames a second apart the rig never jumps, at the edges of its windows neither."""
    settings = clean(scenarios=(Scenario("drift", 10, 60), Scenario("bridge", 20, 50)))
    world = World(site(shrink=24), settings)
    steps = [world.truth(START + timedelta(seconds=s)) for s in range(0, 4000, 4)]
    jumps = np.diff([np.append(s.motion.vector, s.displacement_mm) for s in steps], axis=0)
    assert np.abs(jumps[:, :3]).max() < 2e-5
    assert np.abs(jumps[:, 3:]).max() < 0.05
    assert np.abs(steps[-1].motion.vector).max() < 1e-12


def test_images_are_repeatable() -> None:
    """Two worlds of one seed give the same image of an instant; another instant, other noise."""
    here, there = World(site(), SimSettings()), World(site(), SimSettings())
    still = START - timedelta(minutes=1)
    image = here.render("main", still)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, there.render("main", still))
    again = here.render("main", still + timedelta(seconds=1)).astype(int)
    assert 0.3 < np.std(again - image) < 4.0


def test_noise_is_shot_and_read_noise() -> None:
    """The noise of a flat grey patch is sqrt(electrons + read^2), in DN."""
    world = World(site(), replace(SimSettings(), sensor=replace(clean().sensor, noise=True)))
    still = START - timedelta(minutes=1)
    a = world.render("main", still)[:40].astype(float) / 65535.0
    b = world.render("main", still + timedelta(milliseconds=1))[:40].astype(float) / 65535.0
    sensor, pedestal = world.settings.sensor, world.settings.optics.pedestal
    electrons = (a.mean() - pedestal) * sensor.full_well_e
    expected = np.sqrt(electrons + sensor.read_noise_e**2) / sensor.full_well_e
    assert np.std(a - b) / np.sqrt(2.0) == pytest.approx(expected, rel=0.03)
