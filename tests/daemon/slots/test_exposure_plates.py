"""Before and after a calibration the light is followed on all targets of the main image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.exposure.exposure_rule import Exposure, ExposureRule
from core.images import GreyImage
from core.measurement import look_at_pair
from core.results import Displacement, Flag, Measurement, Reason, TargetMeasurement
from core.rig.calibrated_target import CalibratedTarget
from core.site import CirclesTarget, ExtraTarget, Site, TargetRole
from daemon.calibration.view_check import further_problems, see_pair
from daemon.slots.exposure import ExposureLoop
from drivers.protocols import CapturedFrame, CapturedPair, Image, Role
from drivers.sim.settings import SimPlate, SimSettings
from drivers.sim.world import World
from tests.core.places import seen_there
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


SETTINGS = SimSettings(seed=2, plates=(SimPlate("pier", offset_mm=(34.0, -5.0)),))


def _site() -> Site:
    main_target = CirclesTarget(0.6 * CENTRES_MM, np.full(5, 5.0), 11000.0, 20.0)
    beside = CirclesTarget(0.45 * CENTRES_MM, np.full(5, 3.5), 11000.0, 20.0)
    place_px = np.array([531.0, 231.0])
    return small_site(
        main_target=main_target,
        extra_targets=(ExtraTarget("pier", TargetRole.FIXED, beside, place_px),),
    )


def _pair(site: Site, *, sunny: bool) -> CapturedPair:
    """The right half of the image, with the further target, may be in the sun."""
    world = World(site, SETTINGS)
    main, sub = (world.render(role, reference_utc(SETTINGS)) for role in ("main", "sub"))
    lit = main.astype(float)
    if sunny:
        lit[:, int(0.5 * main.shape[1] + 19.0 * site.nominal_px_per_mm) :] *= 2.5
    return CapturedPair(_frame(np.minimum(lit, 255).astype(np.uint8)), _frame(sub), 0.0)


@pytest.mark.parametrize("brighter", [True, False])
def test_a_further_target_that_would_be_overexposed_is_noticed(brighter: bool) -> None:
    site = _site()
    pair = _pair(site, sunny=brighter)
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


@pytest.mark.parametrize("brighter", [True, False])
def test_after_a_calibration_the_light_is_followed_on_all_targets_too(brighter: bool) -> None:
    """By where the row says that they are; one that is not seen is left out."""
    site = _site()
    pair = _pair(site, sunny=brighter)
    check = see_pair(pair, site)
    main, pier = check.discs, check.further[0]
    assert main is not None
    assert pier is not None
    scale, noise_mm2 = site.nominal_px_per_mm, np.eye(2)
    flip = scale * np.diag([1.0, -1.0])
    target = CalibratedTarget(
        "pier", TargetRole.FIXED, pier.points_px, np.ones(5), flip, 11000.0, 20.0
    )
    made = seen_there(main.points_px, flip, target)
    raw = Displacement(np.zeros(2), noise_mm2)
    of_pier = TargetMeasurement("pier", TargetRole.FIXED, Flag.GOOD, (), raw, raw)
    seen = Measurement(Flag.GOOD, (), raw, raw, None, targets=(of_pier,))
    hidden = replace(seen, targets=(replace(of_pier, raw=None),))
    for measurement, followed in ((seen, brighter), (hidden, False)):
        loop, asked = ExposureLoop(site, {"main": RULE, "sub": RULE}), Asked()
        loop.follow(asked, [pair], measurement, made, roles=["main"])
        is_darker = asked.main_us is not None and asked.main_us < 4500.0
        assert is_darker == followed


def test_before_a_calibration_the_main_target_is_told_from_the_further_one() -> None:
    site = _site()
    pair = _pair(site, sunny=False)
    seen = look_at_pair(GreyImage(pair.main.pixels), GreyImage(pair.sub.pixels), site)
    assert seen.reasons == (Reason.NO_CALIBRATION,)
    assert seen.diagnostics.discs_found == 5
