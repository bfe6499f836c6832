"""The plate found in an image of any kind, by its layout alone."""

from __future__ import annotations

import numpy as np
import pytest

from core.errors import ImageError, TargetNotFoundError
from core.target import find_target
from tests.core.targets import TARGET, TargetScene
from tests.core.test_discs import UNLIKE


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


def test_colour_images_and_empty_ones_are_refused() -> None:
    with pytest.raises(ImageError, match="convert it first"):
        find_target(np.zeros((40, 60, 3), np.uint8), TARGET.centres_mm, 8.0)
    with pytest.raises(TargetNotFoundError):
        find_target(np.zeros((400, 640), np.uint8), TARGET.centres_mm, 8.0)
