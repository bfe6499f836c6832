"""A target's light is that of its own white and black, whatever else is in the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board
from core.discs.disc_finder import find_discs
from core.exposure.target_light import TargetLight, area_light, board_light, box_about, disc_light
from core.images import GreyImage
from core.measurement import measure_pair
from drivers.sim.render import ORDINARY, Exposed
from drivers.sim.settings import Optics, Scenario, SimSettings
from drivers.sim.world import World
from tests.core.scenes import small_site
from tests.core.sessions import Session

SITE = small_site()
OPTICS = Optics(light_change=0.0, main_shading=0.0, sub_shading=0.0)


def looked(
    world: World, shown: World | None = None, exposed: Exposed = ORDINARY
) -> tuple[TargetLight, TargetLight]:
    """Light of both targets in what `shown` shows, where they are found in `world`'s images."""
    at = world.settings.start_utc
    clear = {role: GreyImage(world.render(role, at)) for role in ("main", "sub")}
    seen = {
        role: GreyImage((shown or world).render(role, at, None, exposed))
        for role in ("main", "sub")
    }
    discs = find_discs(clear["main"], SITE.main_target, SITE.nominal_px_per_mm)
    radii = SITE.nominal_px_per_mm * SITE.main_target.diameters_mm / 2.0
    board = Board.nominal(SITE.sub_target)
    view = detect_board(clear["sub"], board).view
    main = disc_light(seen["main"], discs.points_px, radii)
    sub = board_light(seen["sub"], board, view.index, view.points_px)
    assert main is not None
    assert sub is not None
    return main, sub


def world(*scenarios: Scenario, optics: Optics = OPTICS) -> World:
    return World(SITE, SimSettings(seed=3, scenarios=scenarios, optics=optics))


def test_white_and_black_are_the_targets_own() -> None:
    main, sub = looked(world())
    assert (main.white, main.black) == pytest.approx((0.74, 0.04), abs=0.015)
    assert (sub.white, sub.black) == pytest.approx((0.76, 0.06), abs=0.015)
    assert main.saturated == sub.saturated == 0.0


def test_saturation_is_counted_on_the_white_parts() -> None:
    main, sub = looked(world(), exposed=Exposed(time=2.0))
    assert main.saturated == sub.saturated == 1.0
    assert (main.white, sub.white) == (1.0, 1.0)
    assert main.black < 0.1


@pytest.mark.parametrize("kind", ["insect_main", "insect_sub", "cobweb"])
def test_an_insect_or_a_web_does_not_change_it(kind: str) -> None:
    """What sits on some of the white parts is not what the camera is to be set by."""
    clear = looked(world())
    disturbed = looked(world(), world(Scenario(kind)))
    for before, after in zip(clear, disturbed, strict=True):
        assert after.white == pytest.approx(before.white, rel=0.04)
        assert after.saturated == 0.0


def test_a_spot_of_glare_does_not_change_it() -> None:
    """A lamp's reflection over one disc in five and a tenth of the board."""
    settings = world()
    at = settings.settings.start_utc
    main, sub = (GreyImage(settings.render(role, at).copy()) for role in ("main", "sub"))
    discs = find_discs(main, SITE.main_target, SITE.nominal_px_per_mm)
    radii = SITE.nominal_px_per_mm * SITE.main_target.diameters_mm / 2.0
    board = Board.nominal(SITE.sub_target)
    view = detect_board(sub, board).view
    for image, (u, v) in ((main, discs.points_px[0].astype(int)), (sub, (200, 120))):
        image.pixels[v - 50 : v + 50, u - 70 : u + 70] = 255
    light = disc_light(main, discs.points_px, radii)
    assert light is not None
    assert light.white == pytest.approx(0.74, abs=0.015)
    assert light.saturated == 0.2
    light = board_light(sub, board, view.index, view.points_px)
    assert light is not None
    assert light.white == pytest.approx(0.76, abs=0.02)
    assert 0.05 < light.saturated < 0.2


def test_the_area_of_a_target_that_is_not_found_tells_dark_from_bright() -> None:
    """Its white is that of the discs, or of whatever stands in its place."""
    at = SimSettings().start_utc
    for scenarios, low, high in (
        ((), 0.7, 0.78),
        ((Scenario("night"),), 0.0, 0.05),
        ((Scenario("cover"),), 0.05, 0.78),
    ):
        image = GreyImage(world(*scenarios).render("main", at))
        clear = GreyImage(world().render("main", at))
        discs = find_discs(clear, SITE.main_target, SITE.nominal_px_per_mm)
        light = area_light(image, box_about(image, discs.points_px, 50.0))
        assert low <= light.white <= high


def test_parts_outside_the_image_count_for_nothing() -> None:
    image = GreyImage(np.full((40, 60), 100, np.uint8))
    points = np.array([[-30.0, 20.0], [30.0, 20.0], [200.0, 20.0]])
    assert disc_light(image, points, np.full(3, 5.0)) is None
    assert box_about(image, points - 500.0, 3.0) == (0, 0, 60, 40)


def test_exposure_does_not_shift_the_displacement(quick: Session) -> None:
    """From under to over the wanted level, by exposure or gain: within 0.001 mm.

    Without noise, and with grey values so fine that their rounding is none either.
    """
    session = quick.with_world(
        sensor=replace(quick.world.settings.sensor, noise=False, bits=16),
    )
    at = session.world.settings.start_utc
    found = []
    for exposed in (
        ORDINARY,
        Exposed(time=0.4),
        Exposed(time=0.7),
        Exposed(time=1.25),
        Exposed(time=0.25, gain=4.0),
    ):
        main, sub = (
            GreyImage(session.world.render(role, at, None, exposed), 16) for role in ("main", "sub")
        )
        measured = measure_pair(main, sub, session.site, session.calibration)
        assert measured.corrected is not None
        found.append(measured.corrected.mm)
    assert np.abs(np.array(found) - found[0]).max() < 0.001
