"""Before a calibration the light is followed on all targets of the main image."""

from __future__ import annotations

import numpy as np
import pytest

from core.exposure.exposure_rule import Exposure, ExposureRule
from core.site import CirclesTarget, ExtraTarget, TargetRole
from daemon.calibration.view_check import further_problems, see_pair
from daemon.slots.exposure import ExposureLoop
from drivers.protocols import CapturedFrame, CapturedPair, Image, Role
from drivers.sim.settings import SimPlate, SimSettings
from drivers.sim.world import World
from tests.core.scenes import CENTRES_MM, reference_utc, small_site

RULE = ExposureRule(Exposure(5000.0, 0.0), 100.0, 20_000.0, 0.0, 10.0, 0.7)


class Asked:
    """A source that notes how it is to expose."""

    def __init__(self) -> None:
        self.main_us: float | None = None

    def set_exposure(self, role: Role, exposure_us: float, gain_db: float | None) -> None:
        assert (role, gain_db) == ("main", 0.0)
        self.main_us = exposure_us


def _frame(pixels: Image) -> CapturedFrame:
    return CapturedFrame(pixels, 8, 1, 0, 0.0, 5000.0, 0.0)


@pytest.mark.parametrize("brighter", [True, False])
def test_a_further_target_that_would_be_overexposed_is_noticed(brighter: bool) -> None:
    """The right half of the image, with the further target, is in the sun."""
    main_target = CirclesTarget(0.6 * CENTRES_MM, np.full(5, 5.0), 11000.0, 20.0)
    beside = CirclesTarget(0.45 * CENTRES_MM, np.full(5, 3.5), 11000.0, 20.0)
    site = small_site(
        main_target=main_target,
        extra_targets=(ExtraTarget("pier", TargetRole.FIXED, beside, np.array([531.0, 231.0])),),
    )
    settings = SimSettings(seed=2, plates=(SimPlate("pier", offset_mm=(34.0, -5.0)),))
    world = World(site, settings)
    main, sub = (world.render(role, reference_utc(settings)) for role in ("main", "sub"))
    sunny = main.astype(float)
    middle_px = int(0.5 * main.shape[1] + 19.0 * site.nominal_px_per_mm)
    sunny[:, middle_px:] *= 2.5
    lit = np.minimum(sunny, 255).astype(np.uint8) if brighter else main
    pair = CapturedPair(_frame(lit), _frame(sub), 0.0)
    loop, asked = ExposureLoop(site, {"main": RULE, "sub": RULE}), Asked()
    loop.follow(asked, [pair], roles=["main"])
    check = see_pair(pair, site)
    assert check.discs is not None
    assert check.further[0] is not None
    problems = list(further_problems(check, site))
    if brighter:
        assert asked.main_us is not None
        assert asked.main_us < 4500.0
        assert problems[0].startswith('target "pier": ')
        assert "is saturated; less light" in problems[0]
    else:
        assert asked.main_us is None or asked.main_us > 4500.0
        assert problems == []
