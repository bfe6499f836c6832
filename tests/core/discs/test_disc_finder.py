"""The main target is found and its discs rightly named; each is located to its own sigma."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from core.discs.blobs import Blobs
from core.discs.disc_finder import Discs, expectation, find_discs, layout_of
from core.discs.layout import identify_discs
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.site import CirclesTarget
from drivers.sim.render import Look
from drivers.sim.settings import Sensor
from tests.core.scenes import CENTRES_MM
from tests.core.targets import CAMERA, PX_PER_MM, TargetScene

UNLIKE = CirclesTarget(CENTRES_MM, np.array([8.0, 6.0, 10.0, 8.0, 12.0]), 11000.0, 20.0)
THREE = CirclesTarget(
    np.array([[-12.0, 6.0], [14.0, 2.0], [-2.0, -9.0]]), np.full(3, 7.0), 11000.0, 20.0
)


def _find(scene: TargetScene, seed: int = 0) -> Discs:
    return find_discs(scene.image(seed), scene.target, PX_PER_MM)


def _assert_right(scene: TargetScene, discs: Discs, within_px: float = 0.02) -> None:
    """Exactly the visible discs are found, each where the disc of this number truly is."""
    shown = np.ones(len(scene.centres_px), dtype=bool)
    shown[list(scene.hidden)] = False
    assert discs.found.tolist() == shown.tolist()
    miss = (discs.points_px - scene.centres_px)[shown]
    assert np.hypot(miss[:, 0], miss[:, 1]).max() < within_px
    assert np.isnan(discs.points_px[~shown]).all()


# ------------------------------------------------------------------ found and named


@pytest.mark.parametrize("target", [TargetScene().target, UNLIKE, THREE])
@pytest.mark.parametrize("roll_deg", [0.0, 20.0, -40.0])
def test_named_in_order_at_any_roll_to_40_degrees(target, roll_deg) -> None:
    """Five equal discs, five of different size, three: the order is that of the config."""
    scene = TargetScene(target=target, roll_deg=roll_deg)
    discs = _find(scene)
    _assert_right(scene, discs)
    assert discs.explained_fraction.min() > 0.97


def test_a_copy_about_half_as_large_beside_it_leaves_no_doubt() -> None:
    """Another plate of the site that the config does not name: smaller, and sharper than ours."""
    layout = layout_of(TargetScene().target)
    ours_px = 300.0 + PX_PER_MM * layout.places_mm
    copy_px = ours_px.max(axis=0) + [80.0, -100.0] + 0.52 * PX_PER_MM * layout.places_mm
    radii_px = PX_PER_MM * np.concatenate([1.07 * layout.radii_mm, 0.52 * layout.radii_mm])
    outlines_px = radii_px[:, None, None] * np.eye(2)
    blobs = Blobs(np.vstack([ours_px, copy_px]), outlines_px, np.full(10, 90.0), np.ones(10))
    named = identify_discs(blobs, layout, expectation(PX_PER_MM))
    assert named is not None
    assert named.unambiguous
    assert named.spots.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("diameter_px", [160, 200, 250, 400])
def test_discs_of_hundreds_of_pixels_are_found(diameter_px) -> None:
    """Their outlines, first seen in a much smaller image, are some pixels off to start with."""
    scale = diameter_px / 8.0
    middle = scale * np.array([24.0, 20.0]) + [0.3, 0.2]
    centres_px = middle + scale * CENTRES_MM * [1.0, -1.0]
    v, u = np.mgrid[: round(scale * 40.0), : round(scale * 48.0)].astype(np.float32)
    grey = np.full(u.shape, 30.0, dtype=np.float32)
    for x, y in centres_px:
        grey += 180.0 * np.clip(0.5 * diameter_px - np.hypot(u - x, v - y) + 0.5, 0.0, 1.0)
    blurred = cv2.GaussianBlur(grey, (0, 0), 0.8)
    blurred += np.random.default_rng(1).normal(size=u.shape)
    image = GreyImage(np.rint(blurred).astype(np.uint8))
    discs = find_discs(image, TargetScene().target, scale)
    assert discs.found.all()
    assert np.abs(discs.points_px - centres_px).max() < 0.02


@pytest.mark.parametrize("tilt_deg", [(20.0, 0.0), (0.0, -20.0), (12.0, 12.0)])
def test_named_when_the_target_is_tilted(tilt_deg) -> None:
    """Discs that look like ellipses, in a layout that is squeezed."""
    scene = TargetScene(tilt_deg=tilt_deg)
    _assert_right(scene, _find(scene))


@pytest.mark.parametrize("hidden", [(0,), (2,), (4,), (0, 1), (1, 2), (3, 4), (0, 4)])
@pytest.mark.parametrize("roll_deg", [0.0, -15.0])
def test_one_or_two_hidden_discs_do_not_matter(hidden, roll_deg) -> None:
    scene = TargetScene(hidden=hidden, roll_deg=roll_deg)
    _assert_right(scene, _find(scene))


@pytest.mark.parametrize("hidden", [(0, 1, 2), (0, 1, 2, 3, 4)])
def test_fewer_than_three_discs_are_refused(hidden) -> None:
    """The message counts them and says how many are needed."""
    with pytest.raises(TargetNotFoundError, match=r"^main target: .*3 are needed$"):
        _find(TargetScene(hidden=hidden))


def test_discs_beyond_the_image_are_not_found() -> None:
    """A target half outside: the three discs inside are named right."""
    scene = TargetScene(middle_mm=(42.0, 0.0), hidden=())
    discs = _find(scene)
    assert discs.found.tolist() == [True, False, True, True, False]
    assert np.nanmax(np.abs(discs.points_px - scene.centres_px)) < 0.02


@pytest.mark.parametrize("hidden", [(), (1,)])
@pytest.mark.parametrize("seed", range(3))
def test_other_bright_spots_are_not_taken_for_discs(seed, hidden) -> None:
    """Six more round white spots of all sizes between the discs."""
    rng = np.random.default_rng(seed)
    spots: list[tuple[float, float, float]] = []
    while len(spots) < 6:
        x, y, r = rng.uniform((-27.0, -23.0, 1.5), (27.0, 23.0, 6.0))
        if np.hypot(*(CENTRES_MM - [x, y]).T).min() > r + 5.5 and all(
            np.hypot(x - a, y - b) > r + c + 1.0 for a, b, c in spots
        ):
            spots.append((float(x), float(y), float(r)))
    scene = TargetScene(spots_mm=tuple(spots), hidden=hidden, roll_deg=-8.0)
    _assert_right(scene, _find(scene))


def test_a_target_of_another_size_is_not_ours() -> None:
    """Half the size by the survey: some other thing with five spots."""
    scene = TargetScene()
    with pytest.raises(TargetNotFoundError):
        find_discs(scene.image(), scene.target, 2.5 * PX_PER_MM)


# ------------------------------------------------------------------ any light


@pytest.mark.parametrize(
    ("scene", "within_px"),
    [
        (TargetScene(light=0.3), 0.02),
        (TargetScene(light=0.05), 0.05),
        (TargetScene(light=0.005, sensor=Sensor(bits=12)), 0.1),
        (TargetScene(light=1.6), 0.03),
        (TargetScene(greys=(0.25, 0.2, 0.28)), 0.08),
        (TargetScene(greys=(0.73, 0.03, 0.9)), 0.02),
        (TargetScene(look=Look(0.75, 1.5, 0.9, 1.0)), 0.03),
        (TargetScene(look=Look(4.0, 1.0, 0.0, 0.0)), 0.03),
    ],
    ids=["dim", "weak", "night", "saturated", "pale", "bright wall", "uneven", "out of focus"],
)
def test_found_in_any_light_that_a_person_could_read(scene, within_px) -> None:
    _assert_right(scene, _find(scene), within_px)


def test_a_gradient_of_light_does_not_pull_the_centres() -> None:
    """Ten times more light at one side than at the other, 1 % a pixel across a disc."""
    scene = TargetScene()
    slope = np.linspace(0.1, 1.0, CAMERA.width_px, dtype=np.float32)
    light = np.broadcast_to(slope, (CAMERA.height_px, CAMERA.width_px))
    image = scene.images(1, light=light)[0]
    _assert_right(scene, find_discs(image, scene.target, PX_PER_MM))


def test_a_shadow_edge_across_a_disc_is_noticed() -> None:
    """The disc that a sharp shadow cuts is not clean, the others are exact."""
    scene = TargetScene()
    light = np.ones((CAMERA.height_px, CAMERA.width_px), np.float32)
    light[:, : round(scene.centres_px[2, 0])] = 0.25
    discs = find_discs(scene.images(1, light=light)[0], scene.target, PX_PER_MM)
    assert not discs.found[2] or discs.explained_fraction[2] < 0.9
    others = np.array([0, 1, 3, 4])
    assert discs.found[others].all()
    assert np.abs((discs.points_px - scene.centres_px)[others]).max() < 0.02


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((400, 640), np.uint8),
        np.full((400, 640), 255, np.uint8),
        np.random.default_rng(1).integers(0, 256, (400, 640)).astype(np.uint8),
        np.random.default_rng(1).integers(0, 65536, (400, 640)).astype(np.uint16),
    ],
    ids=["black", "white", "noise", "16-bit noise"],
)
def test_an_image_without_the_target_says_so(pixels) -> None:
    with pytest.raises(TargetNotFoundError, match=r"^main target: [^\n]+$"):
        find_discs(GreyImage(pixels, pixels.itemsize * 8), TargetScene().target, PX_PER_MM)


# ------------------------------------------------------------------ how well


@pytest.mark.parametrize(
    ("scene", "sigma_px"),
    [
        (TargetScene(roll_deg=3.0), 0.002),
        (TargetScene(light=0.1), 0.007),
        (TargetScene(look=Look(0.75, 1.5, 0.8, 1.0)), 0.002),
        (TargetScene(sensor=Sensor(bits=12)), 0.002),
        (TargetScene(sensor=Sensor(full_well_e=1e6)), 0.0006),
    ],
    ids=["good light", "dim", "uneven", "12 bits", "quiet"],
)
def test_located_to_their_own_sigma(scene, sigma_px) -> None:
    """Forty noises over one scene: the scatter is what each disc's covariance says."""
    seen = [find_discs(image, scene.target, PX_PER_MM) for image in scene.images(40)]
    points = np.stack([discs.points_px for discs in seen])
    covariance = np.stack([discs.covariance_px2 for discs in seen])
    away = points - points.mean(axis=0)
    squares = np.einsum("kni,knij,knj->kn", away, np.linalg.inv(covariance), away)
    assert 0.9 < np.sqrt(squares.mean() / 2.0 * 40 / 39) < 1.1
    assert np.sqrt(np.median(covariance[..., 0, 0])) < sigma_px
    assert np.abs(points.mean(axis=0) - scene.centres_px).max() < 0.006


def test_contrast_and_blur_are_those_of_the_image() -> None:
    """The figures that an engineer reads: 70 % of 255 DN, and the lens's blur."""
    scene = TargetScene()
    sharp = _find(scene)
    soft = _find(replace(scene, look=Look(2.0, 1.0, 0.0, 0.0)))
    assert sharp.contrast_dn == pytest.approx(0.7 * 255, rel=0.02)
    # The pixel itself adds 1/12 px^2.
    assert sharp.blur_px == pytest.approx(np.hypot(0.75, 12**-0.5), rel=0.05)
    assert soft.blur_px == pytest.approx(np.hypot(2.0, 12**-0.5), rel=0.05)
