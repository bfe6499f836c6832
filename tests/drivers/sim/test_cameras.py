"""Simulated cameras and head behave as devices do: triggers, losses, limits, counts, weather."""

from __future__ import annotations

import threading
from dataclasses import replace
from datetime import timedelta

import cv2
import numpy as np
import pytest

from drivers.clock import SteppedClock
from drivers.errors import DeviceLostError, FrameTimeoutError, HeadError
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.head import SimulatedHead
from drivers.sim.light import TrueLight
from drivers.sim.settings import Optics, Scenario, Sensor, SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import clean, site

START = SimSettings().start_utc


def _camera(world: World, role: str = "main") -> tuple[SimulatedCamera, SteppedClock]:
    clock = SteppedClock(START)
    return SimulatedCamera(world, role, clock), clock


def _world(*scenarios: Scenario) -> World:
    return World(site(), SimSettings(scenarios=scenarios))


def test_one_trigger_one_frame() -> None:
    """A frame shows the instant of its trigger, is given once, and counts up."""
    world = _world(Scenario("drift"), Scenario("bridge"))
    camera, clock = _camera(world)
    camera.open()
    camera.arm()
    camera.trigger()
    clock.advance(3600.0)
    frame = camera.fetch(1.0)
    np.testing.assert_array_equal(frame.pixels, world.render("main", START))
    assert (frame.bits, frame.frame_id, frame.trigger_monotonic_s) == (8, 1, 0.0)
    with pytest.raises(FrameTimeoutError, match=r"main camera .*no frame in 2 s"):
        camera.fetch(2.0)
    camera.trigger()
    camera.arm()
    with pytest.raises(FrameTimeoutError):
        camera.fetch(2.0)


def test_a_closed_camera_gives_nothing() -> None:
    """Before `open` and after `close` a camera is not there."""
    camera, _ = _camera(_world())
    with pytest.raises(DeviceLostError):
        camera.trigger()
    camera.open()
    camera.close()
    camera.close()
    with pytest.raises(DeviceLostError):
        camera.arm()


def test_a_lost_camera_comes_back_when_opened() -> None:
    """During its window the one camera is gone, and stays gone until it is opened again."""
    world = _world(Scenario("camera_loss", 5, 10, role="main"))
    (main, clock), (sub, _) = _camera(world), _camera(world, "sub")
    main.open()
    sub.open()
    clock.wait_until(START + timedelta(minutes=6), threading.Event())
    with pytest.raises(DeviceLostError) as caught:
        main.trigger()
    assert caught.value.role == "main"
    with pytest.raises(DeviceLostError):
        main.open()
    clock.wait_until(START + timedelta(minutes=10), threading.Event())
    with pytest.raises(DeviceLostError):
        main.trigger()
    main.open()
    main.trigger()
    assert main.fetch(1.0).pixels.shape == (300, 480)
    sub.trigger()


@pytest.mark.parametrize(("bits", "dtype", "top"), [(8, np.uint8, 255), (12, np.uint16, 4095)])
def test_grey_values_fill_the_bits(bits: int, dtype: type, top: int) -> None:
    """Pixels hold the sensor's bits: white is where the settings say, black near the pedestal."""
    world = World(site(), clean(sensor=Sensor(bits=bits)))
    camera, _ = _camera(world)
    camera.open()
    camera.trigger()
    frame = camera.fetch(1.0)
    assert frame.pixels.dtype == dtype
    assert frame.bits == bits
    optics = world.settings.optics
    assert frame.pixels.max() == pytest.approx(top * (optics.main_white + optics.pedestal), rel=0.1)
    assert frame.pixels.min() == pytest.approx(top * 0.04, rel=0.3)


def test_a_longer_exposure_and_more_gain_make_it_brighter_and_only_the_exposure_less_noisy() -> (
    None
):
    """Twice the light is twice the grey value above the pedestal; the full well ends it."""
    world = World(site(), SimSettings(scenarios=()))
    camera = SimulatedCamera(world, "main", SteppedClock(START), exposure_us=1250.0)
    camera.open()
    grey = {}
    for exposure_us, gain_db in ((1250.0, 0.0), (2500.0, 0.0), (1250.0, 20.0 * np.log10(2.0))):
        camera.set_exposure(exposure_us, gain_db)
        camera.trigger()
        plate = camera.fetch(1.0).pixels[:20, :20].astype(float)  # even light, no edge
        grey[exposure_us, round(gain_db)] = plate.mean(), plate.std()
    pedestal = 255.0 * world.settings.optics.pedestal
    once, longer, amplified = grey.values()
    assert longer[0] - pedestal == pytest.approx(2.0 * (once[0] - pedestal), rel=0.03)
    assert amplified[0] == pytest.approx(longer[0], rel=0.03)
    assert amplified[1] > 1.2 * longer[1] > 1.2 * once[1]
    camera.set_exposure(1e6, 0.0)
    camera.trigger()
    assert camera.fetch(1.0).pixels.min() == 255


def test_dusk_takes_its_time() -> None:
    """Half-way through, the light has fallen to the root of what is left of it at night."""
    settings = SimSettings(
        scenarios=(Scenario("night", 100, 200),),
        optics=Optics(night_light=0.04, dusk_min=40.0, light_change=0.0),
    )
    true = TrueLight(settings)
    light = {minute: true.of("main", minute) for minute in (99, 120, 140, 159, 180, 200)}
    assert light == pytest.approx({99: 1.0, 120: 0.2, 140: 0.04, 159: 0.04, 180: 0.2, 200: 1.0})


# ------------------------------------------------------------------ weather


def _both(*scenarios: Scenario) -> tuple[np.ndarray, np.ndarray]:
    world = _world(*scenarios)
    return world.render("main", START).astype(int), world.render("sub", START).astype(int)


def test_night_is_dark() -> None:
    """At night no grey value reaches a tenth of the range; for one camera only if asked."""
    main, sub = _both(Scenario("night"))
    assert max(main.max(), sub.max()) < 25
    main, sub = _both(Scenario("night", role="main"))
    assert main.max() < 25
    assert sub.max() > 100


def test_an_insect_hides_part_of_one_target() -> None:
    """It darkens some white pixels, a few per cent of the image at most, and of no other image."""
    clear_main, clear_sub = _both()
    main, sub = _both(Scenario("insect_main"))
    assert 10 < np.sum(clear_main - main > 60) < 0.03 * main.size
    np.testing.assert_array_equal(sub, clear_sub)
    main, sub = _both(Scenario("insect_sub"))
    assert 10 < np.sum(clear_sub - sub > 40) < 0.03 * sub.size
    np.testing.assert_array_equal(main, clear_main)


def test_snow_veils_and_speckles() -> None:
    """Snow lowers the contrast of the scene and adds bright specks."""
    clear, _ = _both()
    main, _ = _both(Scenario("snow", role="main"))
    assert np.percentile(main, 2) > np.percentile(clear, 2) + 10
    assert np.sum(main - clear > 50) > 20


def test_rain_veils_and_streaks() -> None:
    """Rain lowers the contrast of the scene, and its streaks are brighter than the black."""
    clear, clear_sub = _both()
    main, sub = _both(Scenario("rain", role="main"))
    assert np.percentile(main, 2) > np.percentile(clear, 2) + 5
    assert np.percentile(main, 99) < np.percentile(clear, 99) - 10
    assert np.sum(main - clear > 20) > 20
    np.testing.assert_array_equal(sub, clear_sub)


def test_glare_saturates() -> None:
    """Glare drives its middle into saturation."""
    main, _ = _both(Scenario("glare", role="main"))
    assert np.mean(main == 255) > 0.005


def test_windows_open_close_and_repeat() -> None:
    """A window is open from its start to before its end, and again a period later."""
    window = Scenario("night", 600, 660, repeat_min=1440)
    inside = [window.minutes_inside(m) is not None for m in (599, 600, 659, 660, 2040, 2100)]
    assert inside == [False, True, True, False, True, False]
    world = _world(Scenario("snow", 1, 2))
    assert world.truth(START + timedelta(seconds=90)).cases == ("snow",)
    assert world.truth(START).cases == ()


# ------------------------------------------------------------------ head and hand


def test_head_truncates_to_counts() -> None:
    """5 deg at 185.14 arc seconds a count is 97 counts, read back as 4.98831 deg (D46 manual)."""
    settings = clean()
    settings = replace(settings, head=replace(settings.head, arcsec_per_count=185.14))
    head = SimulatedHead(World(site(), settings))
    head.move_to(5.0, -5.0)
    assert head.position_deg() == pytest.approx((4.98831, -4.98831), abs=3e-4)
    head.halt()
    head.close()


def test_head_moves_the_rig_and_keeps_its_limits() -> None:
    """A pan moves the target in the main image; beyond a limit nothing moves."""
    world = World(site(), clean(scenarios=()))
    head = SimulatedHead(world)
    before = world.disc_centres_px(START)
    head.move_to(0.1, 0.0)
    moved_mm = np.radians(head.position_deg()[0]) * 11000.0
    assert np.linalg.norm(world.truth(START).false_mm) == pytest.approx(moved_mm, rel=0.03)
    for pan_deg, tilt_deg in ((5.1, 0.0), (0.0, -6.0), (float("nan"), 0.0)):
        with pytest.raises(HeadError, match="beyond its limit"):
            head.move_to(pan_deg, tilt_deg)
    head.move_to(0.0, 0.0)
    np.testing.assert_allclose(world.disc_centres_px(START), before)


def board_tilt_deg(world: World) -> float:
    """By how much the board is tilted against the image, by where its corners are seen."""
    lens = world.geometry.sub
    camera = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    corners_mm = world.geometry.board.corners_mm().reshape(-1, 3)
    seen_px = world.board_corners_px(START).reshape(-1, 2)
    _, turn, _ = cv2.solvePnP(corners_mm, seen_px, camera, lens.distortion)
    return float(np.degrees(np.arccos(cv2.Rodrigues(turn)[0][2, 2])))


def test_board_in_the_hand() -> None:
    """Held boards are tilted up to 25 degrees, mostly in view, all different; then it is bonded."""
    world = World(site(), clean(scenarios=()))
    bonded = world.render("sub", START)
    tilts = []
    for number in range(20):
        world.hold_board(number)
        corners = world.board_corners_px(START).reshape(-1, 2)
        inside = np.all((corners > 0) & (corners < [480, 300]), axis=1)
        assert inside.mean() > 0.6
        tilts.append(board_tilt_deg(world))
    assert 15.0 < max(tilts) <= 25.0 + 1e-6
    assert np.ptp(tilts) > 5.0
    assert not np.array_equal(world.render("sub", START), bonded)
    world.hold_board(None)
    np.testing.assert_array_equal(world.render("sub", START), bonded)


def test_settings_refuse_what_cannot_be() -> None:
    """A blur too small to render, impossible bits and a naive start are refused."""
    with pytest.raises(ValueError, match=r"at least 0\.5"):
        SimSettings(optics=Optics(sub_blur_px=0.3))
    with pytest.raises(ValueError, match="8 to 16"):
        SimSettings(sensor=Sensor(bits=24))
    with pytest.raises(ValueError, match="UTC with Z"):
        SimSettings(start_utc=START.replace(tzinfo=None))
