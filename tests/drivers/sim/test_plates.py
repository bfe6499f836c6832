"""Further plates in the main image stand, move and look as their distance and role say."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from core.site import CirclesTarget, ExtraTarget, Site, TargetRole
from drivers.sim.settings import Breathing, Climate, Motion, Scenario, SimPlate, SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import AS_DRAWN, CENTRES_MM, clean, disc_centroids, site

START = SimSettings().start_utc
LATER = START + timedelta(hours=5)
FAR_MM = 22000.0


def _extra(
    name: str = "abutment",
    role: TargetRole = TargetRole.FIXED,
    distance_mm: float = FAR_MM + 250.0,
    position_px: tuple[float, float] | None = None,
    scale: float = 1.0,
) -> ExtraTarget:
    target = CirclesTarget(scale * CENTRES_MM, np.full(5, scale * 8.0), distance_mm, 20.0)
    return ExtraTarget(name, role, target, None if position_px is None else np.array(position_px))


def _site(*extra: ExtraTarget, shrink: int = 4) -> Site:
    """The field site, with plates of half the target's size."""
    return site(shrink=shrink, distance_mm=FAR_MM, extra_targets=extra)


def _minutes(minutes: float) -> timedelta:
    return timedelta(minutes=minutes)


# ------------------------------------------------------------------ where it stands


def test_discs_are_where_truth_says_and_as_large_as_their_distance_makes_them() -> None:
    """Rendered discs half as far away lie within 0.001 px of the truth, twice as wide."""
    near = _extra(distance_mm=FAR_MM / 2.0, scale=0.5)
    place = _site(near, shrink=2)
    world = World(place, clean(plates=(SimPlate("abutment", offset_mm=(-52.0, 20.0)),)))
    true_px = world.disc_centres_px(LATER, "abutment")
    radius_px = 2.0 * place.main.focal_px / (FAR_MM / 2.0)
    found = disc_centroids(world.render("main", LATER), true_px, radius_px)
    assert found == pytest.approx(true_px, abs=0.001)
    wide_px = np.linalg.norm(true_px[0] - true_px[1])
    assert wide_px == pytest.approx(15.0 * place.main.focal_px / (FAR_MM / 2.0), rel=0.01)


def test_as_drawn_it_stands_at_its_offset() -> None:
    """50 mm right of and 20 mm above the target's middle, seen at its own distance."""
    place = _site(_extra())
    plate = SimPlate("abutment", offset_mm=(120.0, 20.0))
    world = World(place, clean(as_built=AS_DRAWN, scenarios=(), plates=(plate,)), renders=False)
    middle = world.disc_centres_px(START, "abutment")[2] - place.main.centre_px
    px_per_mm = place.main.focal_px / (FAR_MM + 250.0)
    assert middle == pytest.approx([120.0 * px_per_mm, -20.0 * px_per_mm], abs=1e-9)


def test_without_an_offset_it_stands_in_view_beside_the_others() -> None:
    """Three plates find room: all discs inside the image, no two plates' discs near each other."""
    places = [_extra(name, distance_mm=d) for name, d in (("a", 22250.0), ("b", 21000.0))]
    world = World(_site(*places, _extra("c", position_px=(420.0, 60.0))), clean(scenarios=()))
    seen = [world.disc_centres_px(START, name) for name in (None, "a", "b", "c")]
    radius_px = 4.0 * world.site.main.focal_px / 21000.0
    for discs in seen:
        assert np.all(discs > 2.0 * radius_px)
        assert np.all(discs < np.array([479.0, 299.0]) - 2.0 * radius_px)
    for i, discs in enumerate(seen):
        for other in seen[i + 1 :]:
            apart = np.linalg.norm(discs[:, None] - other[None], axis=2)
            assert apart.min() > 4.0 * radius_px
    assert seen[3][2] == pytest.approx([420.0, 60.0], abs=10.0)


@pytest.mark.parametrize(
    ("extra", "plates", "message"),
    [
        (_extra(), (SimPlate("pylon"),), "no plate 'pylon'; the site has: abutment"),
        (
            _extra(),
            (SimPlate("abutment", offset_mm=(30.0, 0.0)),),
            "'abutment' would stand over 'main'",
        ),
        (
            _extra(),
            (SimPlate("abutment", offset_mm=(900.0, 0.0)),),
            "'abutment' would stand outside the main image",
        ),
        (_extra(distance_mm=5000.0), (), "no room for 'abutment'"),
    ],
)
def test_a_plate_that_cannot_be_is_refused(
    extra: ExtraTarget, plates: tuple[SimPlate, ...], message: str
) -> None:
    """The error names the plate and what to do."""
    with pytest.raises(ValueError, match=message):
        World(_site(extra), clean(plates=plates), renders=False)


def test_only_its_own_part_of_the_image_changes() -> None:
    """Beside the plate every pixel is that of the world without it."""
    settings = clean(scenarios=())
    plate = SimPlate("abutment", offset_mm=(110.0, 0.0))
    bare = World(_site(), settings).render("main", START).astype(int)
    plated = World(_site(_extra()), replace(settings, plates=(plate,)))
    changed = np.argwhere(plated.render("main", START) != bare)
    discs = plated.disc_centres_px(START, "abutment")
    reach_px = 2.5 * 8.0 * plated.site.main.focal_px / FAR_MM
    assert len(changed) > 1000
    assert np.all(changed[:, ::-1] > discs.min(axis=0) - reach_px)
    assert np.all(changed[:, ::-1] < discs.max(axis=0) + reach_px)


# ------------------------------------------------------------------ how it moves


def test_parallax() -> None:
    """A rig that shifts by T moves the two images apart by f T (1/d1 - 1/d2)."""
    place = _site(_extra(distance_mm=16000.0))
    settings = clean(
        as_built=AS_DRAWN,
        scenarios=(Scenario("drift"),),
        motion=Motion(drift_mrad=0.0, drift_mm=5.0),
        plates=(SimPlate("abutment", offset_mm=(78.0, 0.0)),),
    )
    world = World(place, settings, renders=False)
    moved = [
        (world.disc_centres_px(LATER, name) - world.disc_centres_px(START, name))[2]
        for name in (None, "abutment")
    ]
    shift_mm = world.geometry.T_CM_CS.R @ world.truth(LATER).motion.t_mm
    assert np.linalg.norm(shift_mm[:2]) > 1.0
    parallax = place.main.focal_px * shift_mm[:2] * (1.0 / 16000.0 - 1.0 / FAR_MM)
    assert moved[1] - moved[0] == pytest.approx(parallax, rel=0.02, abs=0.02)
    assert np.linalg.norm(parallax) > 0.5


def test_a_measured_plate_moves_with_the_bridge_and_a_fixed_one_does_not() -> None:
    """Each by its factor: by itself 1 and 0, else what the settings say; truth says the same."""
    roles = TargetRole.MEASURED, TargetRole.FIXED, TargetRole.MEASURED
    extra = [
        _extra(name, role, 22000.0 + 10.0 * k)
        for k, (name, role) in enumerate(zip(("quarter", "abutment", "third"), roles, strict=True))
    ]
    settings = clean(
        as_built=AS_DRAWN,
        scenarios=(Scenario("bridge"),),
        plates=(SimPlate("quarter", bridge_factor=0.7),),
    )
    world = World(_site(*extra), settings, renders=False)
    truth = world.truth(LATER)
    assert truth.displacement_mm[1] > 3.0
    for name, factor in (("quarter", 0.7), ("abutment", 0.0), ("third", 1.0)):
        expected_mm = factor * truth.displacement_mm
        assert truth.plates[name].displacement_mm == pytest.approx(expected_mm, abs=1e-12)
        moved = world.disc_centres_px(LATER, name) - world.disc_centres_px(START, name)
        px_per_mm = world.site.main.focal_px / FAR_MM
        assert moved[2] == pytest.approx(expected_mm * [px_per_mm, -px_per_mm], rel=1e-2, abs=1e-9)


def test_a_knock_stays_and_creep_grows() -> None:
    """Knocked by (0.3, -0.2) mm an hour after the start; creep of 0.1 mm/sqrt(day), 1 mm in 100."""
    plate = SimPlate("abutment", knock_min=60.0, knock_mm=(0.3, -0.2))
    world = World(_site(_extra()), clean(plates=(plate,)), renders=False)
    for minutes, expected_mm in ((59.9, (0.0, 0.0)), (60.0, (0.3, -0.2)), (9999.0, (0.3, -0.2))):
        moved_mm = world.truth(START + _minutes(minutes)).plates["abutment"].displacement_mm
        assert moved_mm == pytest.approx(expected_mm, abs=1e-12)
    since = world.truth(START + _minutes(90.0), START + _minutes(70.0))
    assert since.plates["abutment"].displacement_mm == pytest.approx([0.0, 0.0], abs=1e-12)
    creeping = replace(plate, knock_mm=(0.0, 0.0), creep_mm_per_sqrt_day=0.1)
    crept_mm = []
    for seed in range(100):
        settings = clean(seed=seed, plates=(creeping,))
        creeps = World(_site(_extra(), shrink=8), settings, renders=False)
        crept_mm.append(
            creeps.truth(START + timedelta(days=100)).plates["abutment"].displacement_mm
        )
    assert np.sqrt(np.mean(np.square(crept_mm))) == pytest.approx(1.0, rel=0.15)


def test_a_hidden_plate_is_not_in_the_image() -> None:
    """While it is hidden the image is that of a world without it, haze and noise included."""
    haze = SimSettings(scenarios=(Scenario("drift"), Scenario("haze")))
    plate = SimPlate("abutment", hidden_min=((30.0, 60.0), (90.0, 95.0)))
    bare, plated = World(_site(), haze), World(_site(_extra()), replace(haze, plates=(plate,)))
    for minutes, hidden in ((29.9, False), (30.0, True), (59.9, True), (60.0, False), (91.0, True)):
        t_utc = START + _minutes(minutes)
        same = np.array_equal(bare.render("main", t_utc), plated.render("main", t_utc))
        assert same is hidden
        assert plated.truth(t_utc).plates["abutment"].hidden is hidden


# ------------------------------------------------------------------ what it shows of the breath


def test_the_shift_of_the_cameras_is_common_to_all_plates() -> None:
    """What the cameras do not share, and what a turning board looks like, shifts both plates alike.

    Only bending differs: it grows as the square of the distance.
    """
    breathing = Breathing(
        cameras_urad_per_k=(2.0, 2.0, 0.0),
        main_px_per_k=(0.02, 0.01),
        board_urad_per_k=(1.0, 1.0, 0.0),
    )
    place = _site(_extra(distance_mm=11000.0, scale=0.5))
    plate = SimPlate("abutment", offset_mm=(-52.0, 20.0))
    settings = clean(
        climate=Climate(air_daily_k=10.0), breathing=breathing, plates=(plate,), seed=2
    )
    world = World(place, settings, renders=False)
    truth = world.truth(LATER + timedelta(hours=7))
    assert np.abs(truth.shift_px).min() > 0.1
    assert truth.plates["abutment"].shift_px == pytest.approx(truth.shift_px, abs=0.01)
    air = replace(settings, breathing=Breathing(air_gradient_k_per_m=0.1))
    bent = World(place, air, renders=False).truth(LATER + timedelta(hours=7))
    half = bent.plates["abutment"].shift_px[1] / bent.shift_px[1]  # (d/2)^2 mm at 1/(d/2) px/mm
    assert half == pytest.approx(0.5, rel=0.01)
