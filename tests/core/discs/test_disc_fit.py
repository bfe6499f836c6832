"""What the fit says of a disc is the image's, not that of where the fit began."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.arrays import FloatArray
from core.discs.disc_finder import find_discs
from core.discs.disc_fit import DiscFits, locate_discs
from core.images import GreyImage
from drivers.sim.effects import draw_cobweb, draw_cover, draw_insect
from drivers.sim.render import MARGIN_PX, CameraRenderer, Look
from drivers.sim.settings import Sensor
from tests.core.targets import CAMERA, LENS, PX_PER_MM, TARGET, TargetScene
from tests.exhaustive import one_of

SAME_PX = 1e-3
CLEAN = 0.95
"""Below this share of explained pixels a row says that the target is partly hidden."""


def _scene(seed: int) -> TargetScene:
    """A clean plate of any size, blur, light, depth and pose that a site may show."""
    rng = np.random.default_rng(seed)
    diameter_mm = rng.uniform(3.0, 9.5)
    target = replace(TARGET, diameters_mm=np.full(5, diameter_mm))
    blur_px = rng.uniform(0.6, 2.5 if diameter_mm > 4.5 else 1.2)
    return TargetScene(
        target=replace(target, distance_mm=11000.0 / rng.uniform(0.7, 1.5)),
        roll_deg=rng.uniform(-30.0, 30.0),
        tilt_deg=tuple(rng.choice([0.0, 1.0]) * rng.uniform(-20.0, 20.0, 2)),
        middle_mm=tuple(rng.uniform(-0.5, 0.5, 2)),
        look=Look(blur_px, rng.uniform(1.0, 1.5), rng.choice([0.0, 0.45, 0.8]), rng.uniform(0, 6)),
        sensor=Sensor(bits=int(rng.choice([8, 12, 16]))),
        light=float(np.exp(rng.uniform(-2.0, 0.3))),
        greys=(0.73, 0.03, rng.uniform(0.1, 0.6)),
    )


def _start(scene: TargetScene) -> tuple[FloatArray, float]:
    """Centres and a radius, px, of discs seen nearly from the front."""
    radius_mm = float(scene.target.diameters_mm[0]) / 2.0
    return scene.centres_px, radius_mm * CAMERA.focal_px / scene.target.distance_mm


def _fit(image: GreyImage, points: FloatArray, radius_px: float | FloatArray) -> DiscFits:
    outline = np.eye(2) * np.broadcast_to(radius_px, (5,))[:, None, None]
    return locate_discs(image.pixels, image.saturation_dn, points, outline)


@pytest.mark.parametrize("seed", range(20, 36, one_of(3)))
def test_the_result_does_not_depend_on_the_start(seed) -> None:
    """Starts off by 1.5 px and by a tenth of the radius: one result, and one verdict."""
    scene = _scene(seed)
    image, (points, radius_px) = scene.image(seed), _start(scene)
    rng = np.random.default_rng(seed)
    fits = [_fit(image, points, radius_px)]
    for _ in range(6):
        off = rng.uniform(-1.5, 1.5, (5, 2))
        fits.append(_fit(image, points + off, radius_px * rng.uniform(0.9, 1.1, 5)))
    centres = np.stack([fit.points_px for fit in fits])
    sigma = np.sqrt(fits[0].covariance_px2[:, [0, 1], [0, 1]])
    assert all(fit.usable.all() for fit in fits)
    assert (np.ptp(centres, axis=0) < np.maximum(SAME_PX, 0.5 * sigma)).all()
    assert min(fit.explained_fraction.min() for fit in fits) > CLEAN
    assert np.ptp([fit.explained_fraction for fit in fits], axis=0).max() < 0.01


@pytest.mark.parametrize("seed", range(200, 260, one_of(3)))
def test_a_clean_plate_is_called_clean(seed) -> None:
    scene = _scene(seed)
    scale = CAMERA.focal_px / scene.target.distance_mm
    seen = find_discs(scene.image(seed), scene.target, scale)
    assert seen.explained_fraction.min() > 0.97


def _disturbed(kind: str, seed: int) -> tuple[GreyImage, TargetScene, FloatArray]:
    """The plate with something before it, drawn as the simulator does, and what that hides (5,)."""
    scene = replace(TargetScene(), roll_deg=3.0)
    rng = np.random.default_rng(seed)
    renderer = CameraRenderer(CAMERA, LENS, scene.look, scene.sensor)
    reflectance = scene.reflectance(renderer)
    clear = reflectance.copy()
    if kind == "insect":
        edge = scene.centres_px[seed % 5] + MARGIN_PX
        angle = rng.uniform(0.0, 2.0 * np.pi)
        edge = edge + 0.5 * 8.0 * PX_PER_MM * np.array([np.cos(angle), np.sin(angle)])
        draw_insect(reflectance, edge, 25.0, rng)
    elif kind == "cobweb":
        draw_cobweb(reflectance, rng)
    else:
        draw_cover(reflectance, rng)
    turns = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    ring = 0.5 * 8.0 * PX_PER_MM * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    u, v = np.rint(scene.centres_px[:, None] + MARGIN_PX + ring).astype(int).transpose(2, 0, 1)
    hidden = (np.abs(reflectance - clear)[v, u] > 0.1).mean(axis=1)
    lit = renderer.lit(reflectance, scene.light)
    return GreyImage(renderer.expose(lit, 0.01, rng), scene.sensor.bits), scene, hidden


@pytest.mark.parametrize("kind", ["insect", "cobweb", "cover"])
@pytest.mark.parametrize("seed", range(5, 10))
def test_what_hides_a_part_of_an_outline_is_noticed(kind, seed) -> None:
    """An insect does not harm the discs that it does not sit on."""
    image, scene, hidden = _disturbed(kind, seed)
    seen = find_discs(image, scene.target, PX_PER_MM)
    assert (seen.explained_fraction[hidden > 0.15] < CLEAN).all()
    if kind == "insect":
        assert (seen.explained_fraction[hidden == 0.0] > 0.97).all()
