"""What temperature and time do to the simulated rig, each against its formula."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from scipy.optimize import least_squares

from drivers.clock import SteppedClock
from drivers.protocols import Role
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.climate import TrueClimate
from drivers.sim.settings import Breathing, Climate, Scenario, SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import AS_DRAWN, clean, disc_centroids, site

COLD = datetime(2026, 3, 1, 3, tzinfo=UTC)
WARM = COLD + timedelta(hours=12)
"""10 K warmer."""
TEN_K = Climate(air_daily_k=5.0)
FAR_MM = 22000.0


def _settings(climate: Climate = TEN_K, **breathing: object) -> SimSettings:
    return clean(
        start_utc=COLD,
        scenarios=(),
        as_built=replace(AS_DRAWN, sub_distortion=(0.0,) * 5),
        climate=climate,
        breathing=Breathing(**breathing),
    )


def _world(climate: Climate = TEN_K, **breathing: object) -> World:
    """A rig as drawn, 22 m from its target, that only breathes."""
    return World(site(distance_mm=FAR_MM), _settings(climate, **breathing), renders=False)


def _moved_px(world: World) -> np.ndarray:
    """(5, 2) how far the discs' images move while it gets 10 K warmer."""
    return world.disc_centres_px(WARM) - world.disc_centres_px(COLD)


# ------------------------------------------------------------------ the main camera


@pytest.mark.parametrize(
    ("turn", "expected_mm"),
    [((0.0, 2.0, 0.0), (0.44, 0.0)), ((2.0, 0.0, 0.0), (0.0, 0.44))],
    ids=["about y", "about x"],
)
def test_a_mutual_turn_of_2_urad_per_k_is_044_mm_at_22_m(
    turn: tuple[float, float, float], expected_mm: tuple[float, float]
) -> None:
    """10 K by 2 urad/K by 22 m is 0.44 mm: right when turned about y, up when about x."""
    world = _world(cameras_urad_per_k=turn)
    px_per_mm = world.site.main.focal_px / FAR_MM
    moved_mm = _moved_px(world)[2] / px_per_mm * [1.0, -1.0]
    assert moved_mm == pytest.approx(expected_mm, abs=1e-6)
    truth = world.truth(WARM)
    assert truth.shift_px == pytest.approx(_moved_px(world)[2], abs=1e-9)
    assert truth.false_mm == pytest.approx([0.0, 0.0], abs=1e-12)
    assert truth.displacement_mm == pytest.approx([0.0, 0.0], abs=1e-12)


def test_roll_turns_the_discs_about_the_optical_axis() -> None:
    """100 urad/K about z for 10 K turn the image by 1 mrad, from x to y (down)."""
    world = _world(cameras_urad_per_k=(0.0, 0.0, 100.0))
    before = world.disc_centres_px(COLD) - world.site.main.centre_px
    expected = 1e-3 * np.stack([-before[:, 1], before[:, 0]], axis=1)
    assert _moved_px(world) == pytest.approx(expected, abs=2e-6 * np.abs(before).max())
    assert np.abs(expected).max() > 0.03


def test_the_main_lens_shifts_and_scales_its_image() -> None:
    """0.02 px/K shift every disc by 0.2 px; 70 ppm/K scale the image about its middle by 7e-4."""
    shifted = _moved_px(_world(main_px_per_k=(0.02, -0.01)))
    assert shifted == pytest.approx(np.tile([0.2, -0.1], (5, 1)), abs=1e-9)
    world = _world(main_scale_ppm_per_k=70.0)
    before = world.disc_centres_px(COLD) - world.site.main.centre_px
    assert _moved_px(world) == pytest.approx(7e-4 * before, abs=1e-9)


def test_images_show_the_breath() -> None:
    """Rendered discs lie within 0.001 px of the true ones, turned, shifted and scaled."""
    settings = _settings(
        cameras_urad_per_k=(30.0, 50.0, 100.0),
        main_px_per_k=(0.3, 0.1),
        main_scale_ppm_per_k=100.0,
    )
    world = World(site(shrink=2), replace(settings, as_built=SimSettings().as_built))
    true_px = world.disc_centres_px(WARM)
    assert np.abs(true_px - world.disc_centres_px(COLD)).max() > 30.0
    radius_px = 4.0 * world.site.main.focal_px / 11000.0
    found = disc_centroids(world.render("main", WARM), true_px, radius_px)
    assert found == pytest.approx(true_px, abs=0.001)
    back = disc_centroids(world.render("main", COLD), world.disc_centres_px(COLD), radius_px)
    assert back == pytest.approx(world.disc_centres_px(COLD), abs=0.001)


def test_air_bends_the_line_of_sight() -> None:
    """0.2 K/m colder above than at night sinks the target by 1/2 1e-6 0.2 22^2 m = 0.0484 mm."""
    world = _world(air_gradient_k_per_m=0.1)
    px_per_mm = world.site.main.focal_px / FAR_MM
    assert _moved_px(world)[2] == pytest.approx([0.0, 0.0484 * px_per_mm], rel=1e-6)


# ------------------------------------------------------------------ the sub-camera and its board


def test_the_sub_lens_shifts_the_board_only() -> None:
    """0.05 px/K shift all corners by 0.5 px, and nothing in the main image."""
    world = _world(sub_px_per_k=(0.05, 0.0))
    moved = world.board_corners_px(WARM) - world.board_corners_px(COLD)
    assert moved == pytest.approx(np.broadcast_to([0.5, 0.0], moved.shape), abs=1e-9)
    assert np.abs(_moved_px(world)).max() == 0.0


@pytest.mark.parametrize(("k1", "at_least_mm"), [(0.0, 0.0), (-0.09, 0.8)])
def test_a_shift_of_a_distorted_sub_lens_is_taken_for_a_turn_of_the_rig(
    k1: float, at_least_mm: float
) -> None:
    """0.2 px of a 6 mm lens with k1 = -0.09 are 41 urad, 0.9 mm at 22 m; without distortion none.

    As a least-squares fit of the board's pose with the lens of the reference finds it.
    """
    built = replace(AS_DRAWN, sub_distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    settings = replace(_settings(sub_px_per_k=(0.02, 0.0)), as_built=built)
    world = World(site(shrink=1, distance_mm=FAR_MM), settings, renders=False)
    lens, T_CS_WS = world.geometry.sub, world.geometry.T_CS_WS
    corners_mm = world.geometry.board.corners_mm().reshape(-1, 3)
    seen_px = world.board_corners_px(WARM).reshape(-1, 2)
    inside = np.all((seen_px > 0.0) & (seen_px < [1919.0, 1199.0]), axis=1)
    unit = np.repeat([1e-4, 1e-2], 3)

    def misses_px(step: np.ndarray) -> np.ndarray:
        pose = T_CS_WS.perturbed(unit * step)
        return (lens.project(pose.apply(corners_mm[inside])) - seen_px[inside]).ravel()

    turn_rad = (unit * least_squares(misses_px, np.zeros(6), xtol=1e-12, ftol=1e-12).x)[:3]
    shift_mm = world.truth(WARM).shift_px * FAR_MM / world.site.main.focal_px
    assert np.abs(shift_mm[0]) == pytest.approx(np.abs(turn_rad[1]) * FAR_MM, rel=0.02, abs=0.012)
    assert np.abs(shift_mm[0]) >= at_least_mm


def test_a_turning_board_is_taken_for_the_rig() -> None:
    """10 urad of the board about its y axis, and the sub-camera has the main camera turn so far.

    Nothing moves in the main image. The rig seems to turn about the board's middle, 50 mm from the
    sub-camera and 130 mm from the main one.
    """
    world = _world(board_urad_per_k=(0.0, 1.0, 0.0))
    truth = world.truth(WARM)
    assert np.abs(_moved_px(world)).max() < 1e-9
    assert np.abs(truth.motion.vector).max() < 1e-12
    off_mm = np.abs(truth.shift_px) * FAR_MM / world.site.main.focal_px
    assert off_mm == pytest.approx([10e-6 * (FAR_MM + 130.0), 0.0], abs=1e-5)


def test_a_board_turns_about_its_middle() -> None:
    """100 urad/K about the normal for 10 K roll the corners by 1 mrad, from x to y."""
    world = _world(board_urad_per_k=(0.0, 0.0, 100.0))
    before = world.board_corners_px(COLD)
    moved = world.board_corners_px(WARM) - before
    arm = before - world.site.sub.centre_px
    assert moved == pytest.approx(1e-3 * np.stack([-arm[..., 1], arm[..., 0]], -1), abs=2e-4)
    assert np.abs(world.truth(WARM).shift_px).max() < 1e-9


@pytest.mark.parametrize("held_mm", [None, (0.0, 0.0)], ids=["middle", "corner"])
def test_a_board_grows_about_the_point_that_holds_it(held_mm: tuple[float, float] | None) -> None:
    """60 ppm/K for 10 K: corners move apart by 6e-4 of their distance from that point."""
    world = _world(board_ppm_per_k=60.0, board_fixed_mm=held_mm)
    before = world.board_corners_px(COLD)
    still_px = world.site.sub.centre_px if held_mm is None else before[0, 0]
    grown = world.board_corners_px(WARM) - before
    assert grown == pytest.approx(6e-4 * (before - still_px), abs=1e-9)
    assert np.abs(grown).max() > 0.09


# ------------------------------------------------------------------ creep


def test_creep_grows_with_the_root_of_time() -> None:
    """Over many rigs 0.5 urad/sqrt(day) are 5 urad rms after 100 days, and 2.5 after 25."""
    small = site(distance_mm=FAR_MM, shrink=8)
    day = timedelta(days=1)
    shifts = []
    for seed in range(150):
        settings = replace(_settings(cameras_urad_per_sqrt_day=(0.5, 0.5, 0.0)), seed=seed)
        world = World(small, settings, renders=False)
        shifts.append([world.truth(COLD + days * day).shift_px for days in (25, 100)])
    urad = np.array(shifts) / small.main.focal_px * 1e6
    rms = np.sqrt((urad**2).mean(axis=(0, 2)))
    assert rms == pytest.approx([2.5, 5.0], rel=0.15)


def test_any_instant_can_be_asked_for_alone() -> None:
    """Asked late first or in order, a world of the same seed says the same; nothing jumps."""
    climate = Climate(air_weather_k=3.0, air_seasonal_k=10.0, camera_lag_h=2.0)
    creep = {"cameras_urad_per_sqrt_day": (1.0,) * 3, "board_urad_per_sqrt_day": (1.0,) * 3}
    breathing = {"cameras_urad_per_k": (2.0, 2.0, 1.0), **creep}
    hours = [timedelta(hours=h) for h in range(0, 24 * 40, 7)]
    forth, back = _world(climate, **breathing), _world(climate, **breathing)
    in_order = [forth.truth(COLD + hour).shift_px for hour in hours]
    reversed_order = [back.truth(COLD + hour).shift_px for hour in reversed(hours)]
    np.testing.assert_array_equal(in_order, reversed_order[::-1])
    seconds = [forth.truth(COLD + timedelta(days=20, seconds=s)).shift_px for s in range(-60, 60)]
    assert np.abs(np.diff(seconds, axis=0)).max() < 1e-3


# ------------------------------------------------------------------ temperature


def test_cameras_follow_the_air_later_and_less() -> None:
    """Behind a lag of tau the daily wave is lower by 1 / hypot(1, w tau) and later by its angle."""
    lag_h = 3.0
    climate = TrueClimate(
        SimSettings(climate=Climate(air_daily_k=8.0, camera_lag_h=lag_h, main_above_air_k=21.0))
    )
    hours = [COLD + timedelta(minutes=10 * k) for k in range(144)]
    air = np.array([climate.air_c(t) for t in hours])
    main = np.array([climate.camera_c("main", t) for t in hours])
    rate = np.pi / 12.0 * lag_h
    assert np.ptp(air) == pytest.approx(16.0, rel=1e-4)
    assert hours[int(air.argmax())].hour == 15
    assert np.ptp(main) == pytest.approx(16.0 / np.hypot(1.0, rate), rel=1e-3)
    later_h = 12.0 / np.pi * np.arctan(rate)
    assert (main.argmax() - air.argmax()) / 6.0 == pytest.approx(later_h, abs=0.1)
    assert main.mean() == pytest.approx(15.0 + 21.0, abs=1e-6)


def test_seasons_and_weather() -> None:
    """Coldest in January and warmest in July; the weather adds its sigma, other seeds other."""
    season = TrueClimate(SimSettings(climate=Climate(air_daily_k=0.0, air_seasonal_k=10.0)))
    days = [datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=d) for d in range(365)]
    air = np.array([season.air_c(t) for t in days])
    assert (days[int(air.argmin())].month, days[int(air.argmax())].month) == (1, 7)
    assert np.ptp(air) == pytest.approx(20.0, rel=1e-3)
    weather = Climate(air_daily_k=0.0, air_weather_k=3.0)
    seen = [
        [TrueClimate(SimSettings(seed=seed, climate=weather)).air_c(t) for t in days]
        for seed in range(10)
    ]
    assert np.std(seen) == pytest.approx(3.0, rel=0.1)
    assert np.std(seen, axis=0).min() > 0.5


def test_cameras_report_their_temperature() -> None:
    """A frame says how warm its camera is in the world, to 0.01 K, and no more than its sensor."""
    world = World(site(shrink=24), _settings(replace(TEN_K, sub_above_air_k=18.0)))
    reported = {}
    for role in ("main", "sub"):
        camera = SimulatedCamera(world, role, SteppedClock(WARM))
        camera.open()
        camera.trigger()
        reported[role] = camera.fetch(1.0).temperature_c
    assert reported == {"main": 40.0, "sub": 38.0}
    assert world.truth(WARM).temperature.main_c == pytest.approx(40.0)
    assert world.truth(WARM).temperature.air_c == pytest.approx(20.0)
    noisy = _world(replace(TEN_K, sensor_noise_k=0.2))
    said = [noisy.reported_c("main", WARM + timedelta(seconds=s)) for s in range(200)]
    assert np.std(said) == pytest.approx(0.2, rel=0.2)
    assert said[0] == noisy.reported_c("main", WARM)


# ------------------------------------------------------------------ at rest, and without it


def test_before_the_start_a_world_that_breathes_looks_like_one_that_does_not() -> None:
    """Calibration is before the start: same pixels, constant temperature."""
    plain = replace(_settings(), breathing=Breathing(), climate=Climate(), seed=4)
    breathing = Breathing(
        cameras_urad_per_k=(9.0, 9.0, 9.0),
        cameras_urad_per_sqrt_day=(9.0, 9.0, 9.0),
        main_px_per_k=(1.0, 1.0),
        main_scale_ppm_per_k=50.0,
        sub_px_per_k=(1.0, 1.0),
        board_ppm_per_k=60.0,
        board_urad_per_k=(9.0, 9.0, 9.0),
        air_gradient_k_per_m=1.0,
    )
    still, alive = World(site(), plain), World(site(), replace(plain, breathing=breathing))
    for role in ("main", "sub"):
        for before in (timedelta(minutes=30), timedelta(0)):
            np.testing.assert_array_equal(
                still.render(role, COLD - before), alive.render(role, COLD - before)
            )
        assert np.any(still.render(role, WARM) != alive.render(role, WARM))
    assert alive.temperatures(COLD - timedelta(hours=5)) == alive.temperatures(COLD)


def test_held_still_nothing_breathes_or_moves_but_noise_and_hours_go_on() -> None:
    """A rig that is held still shows the same scene hours later; let go, it has moved on."""
    settings = replace(
        _settings(cameras_urad_per_k=(9.0, 9.0, 0.0)),
        scenarios=(Scenario("drift"), Scenario("bridge")),
    )
    world = World(site(shrink=8), settings)
    later = WARM + timedelta(hours=9)
    world.hold_still(WARM)
    held = world.disc_centres_px(WARM)
    np.testing.assert_array_equal(world.disc_centres_px(later), held)
    np.testing.assert_array_equal(world.render("main", later), world.render("main", WARM))
    assert world.truth(later).motion.vector == pytest.approx(world.truth(WARM).motion.vector)
    assert world.temperatures(later) == world.temperatures(WARM)
    world.hold_still(None)
    assert np.abs(world.disc_centres_px(later) - held).max() > 0.3


@pytest.mark.parametrize(
    ("minute", "role", "expected"),
    [
        (
            -5,
            "main",
            "4b4b4b4d4d4c4d4a4b4c4d4d4c4c4c4d4b4c4d0a0ac54d4b4c4c4c0a0a934c4c4a4c4c4c4d4d4d4c",
        ),
        (
            150,
            "main",
            "49494b4a4a484a49494a4a0a0a0a494a4a4a4a0ac00a4a4a47494a0a0a0a49494a4b4b4a4a4a4a49",
        ),
        (
            700,
            "main",
            "4b4b4c4b4c4b4c4b4a4b4b4d4c4c4c4c4a4c4c0b0b0a4b4c4b4b4d0a0b0a4b4b4a4b4c0a0b0a4b4a",
        ),
        (
            150,
            "sub",
            "6b808e927c5a108f7588845c281b4e987c8f2552463949a17b8e0e12a8aca7a0768a0e14a7aaa499",
        ),
    ],
)
def test_a_world_without_breath_or_plates_gives_the_images_that_it_always_gave(
    minute: int, role: Role, expected: str
) -> None:
    """Grey values as recorded before the rig could breathe, weather and noise included.

    To one grey value: other processors may round the last bit of a float otherwise.
    """
    settings = SimSettings(
        seed=5, scenarios=(Scenario("drift"), Scenario("bridge"), Scenario("haze", 100, 200))
    )
    image = World(site(), settings).render(role, settings.start_utc + timedelta(minutes=minute))
    assert list(image[::60, ::60].tobytes()) == pytest.approx(list(bytes.fromhex(expected)), abs=1)
