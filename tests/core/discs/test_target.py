"""The plate found in an image of any kind, by its layout alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.discs.target import find_target
from core.errors import ImageError, TargetNotFoundError
from core.site import CirclesTarget
from tests.core.discs.test_disc_finder import UNLIKE
from tests.core.scenes import CENTRES_MM
from tests.core.targets import TARGET, TargetScene


@pytest.mark.parametrize("target", [TARGET, UNLIKE])
@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (35.0, 20.0)])
def test_found_and_named_without_a_scale(target, tilt_deg) -> None:
    """Discs of one size and of several, tilted: each centre where it truly is."""
    scene = TargetScene(target=target, roll_deg=25.0, tilt_deg=tilt_deg)
    seen = find_target(scene.image(), target.centres_mm, target.diameters_mm)
    assert seen.found.all()
    assert np.abs(seen.points_px - scene.centres_px).max() < 0.03


def test_a_symmetric_layout_turned_on_its_side_needs_a_hint() -> None:
    """Rolled by 90 degrees an X has two names; where its discs were before decides."""
    scene = TargetScene(roll_deg=90.0)
    with pytest.raises(TargetNotFoundError, match="more than one way"):
        find_target(scene.image(), TARGET.centres_mm, 8.0)
    seen = find_target(scene.image(), TARGET.centres_mm, 8.0, near=scene.centres_px + 5.0)
    assert np.abs(seen.points_px - scene.centres_px).max() < 0.03


def test_unlike_discs_are_named_upside_down() -> None:
    scene = TargetScene(target=UNLIKE, roll_deg=170.0)
    seen = find_target(scene.image(), UNLIKE.centres_mm, UNLIKE.diameters_mm)
    assert np.abs(seen.points_px - scene.centres_px).max() < 0.03


PLATE = CirclesTarget(CENTRES_MM * 1.5, np.array([6.0, 6.0, 20.0, 6.0, 6.0]), 11000.0, 20.0)
"""As found on a real plate: a large disc between four small ones."""
CENTRE_SIGMA_PX = 0.15
"""Overexposure widens outlines, of which the middle under perspective follows to so much."""


def _video(scene: TargetScene, smear_px: int = 1) -> np.ndarray:
    """As a video camera shows it: smeared along a row, sharpened, the white burnt out, coarse."""
    grey = scene.image().pixels.astype(np.float32)
    grey = cv2.blur(grey, (smear_px, 1))
    sharp = grey + 1.5 * (grey - np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.5)))
    noise = np.random.default_rng(3).normal(0.0, 3.0, grey.shape)
    return np.clip(1.6 * sharp + noise, 0, 253).astype(np.uint8)


@pytest.mark.parametrize("hidden", [(), (0,), (1,), (3,), (4,)])
@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (50.0, -20.0), (-55.0, 10.0)])
def test_sharpened_and_burnt_out_images_keep_every_disc(tilt_deg, hidden) -> None:
    """Edges are sharper than light makes them; with one disc covered three lie on a line."""
    scene = TargetScene(target=PLATE, roll_deg=-10.0, tilt_deg=tilt_deg, hidden=hidden)
    seen = find_target(_video(scene), PLATE.centres_mm, PLATE.diameters_mm)
    assert seen.found.tolist() == [k not in hidden for k in range(5)]
    miss = (seen.points_px - scene.centres_px)[seen.found]
    assert np.abs(miss).max() < 3.0 * CENTRE_SIGMA_PX


@pytest.mark.parametrize("stated_mm", [5.0, 7.3])
def test_small_discs_of_another_size_than_stated_are_the_same_discs(stated_mm) -> None:
    """Four that agree with one another say how large they are."""
    scene = TargetScene(target=PLATE, roll_deg=5.0, tilt_deg=(30.0, 20.0))
    stated = np.where(PLATE.diameters_mm < 10.0, stated_mm, PLATE.diameters_mm)
    seen = find_target(scene.image(), PLATE.centres_mm, stated)
    assert seen.found.all()
    assert np.abs(seen.points_px - scene.centres_px).max() < 0.03


def test_discs_smeared_by_motion_are_found() -> None:
    """Half a disc's width of smear: each is found, about its middle."""
    scene = TargetScene(target=PLATE, roll_deg=-10.0, tilt_deg=(20.0, 0.0))
    width_px = float(np.ptp(scene.centres_px[:, 0])) * 6.0 / 45.0
    image = _video(scene, round(width_px / 4) * 2 + 1)
    seen = find_target(image, PLATE.centres_mm, PLATE.diameters_mm)
    assert seen.found.all()
    assert np.abs(seen.points_px - scene.centres_px).max() < 0.1 * width_px


def test_colour_images_and_empty_ones_are_refused() -> None:
    with pytest.raises(ImageError, match="convert it first"):
        find_target(np.zeros((40, 60, 3), np.uint8), TARGET.centres_mm, 8.0)
    with pytest.raises(TargetNotFoundError):
        find_target(np.zeros((400, 640), np.uint8), TARGET.centres_mm, 8.0)
