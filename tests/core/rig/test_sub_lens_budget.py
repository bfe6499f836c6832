"""What a warm sub lens does to the displacement, and what the stability budget allows for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.geometry.lens import Lens
from core.lens_model import LensModel
from core.moment import Moment
from core.rig.stability import season_sentence, stability_terms, turn_by_sub_shift
from core.site import CheckerboardTarget, Site, StabilityBudget
from drivers.sim.breathing import pose_by_shift
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.core.scenes import small_site


def _site(**stability: float) -> Site:
    nothing = dict.fromkeys(StabilityBudget.__slots__, 0.0)
    board = CheckerboardTarget(32, 22, 2.0, 50.0)  # reaches beyond the image
    return small_site(
        22000.0,
        sub_target=board,
        stability=StabilityBudget(**(nothing | stability)),
    )


def _sigma_mm(site: Site, lens: Lens | None = None) -> float:
    scale = site.nominal_px_per_mm
    terms = stability_terms(site, scale, Moment(0.0, 0.0), Moment(3600.0, 10.0), lens)
    return float(np.sqrt(sum(term.sigma_mm(scale) ** 2 for term in terms)))


def test_the_budget_of_a_shifted_sub_image_is_the_turn_that_the_simulated_rig_shows() -> None:
    """Which shifts the true corners of the board and fits the pose by finite differences."""
    site = _site(sub_px_per_k=0.02)
    geometry = World(site, SimSettings(seed=3), renders=False).geometry
    lens = geometry.sub
    shifted = [
        pose_by_shift(lens, site.sub, geometry.T_CS_WS, geometry.board, 0.2 * shift_px)[:2]
        for shift_px in np.eye(2)
    ]
    apparent_mm = np.sqrt((np.array(shifted) ** 2).sum() / 2.0) * site.main_target.distance_mm
    parameters = [lens.fx_px, lens.fy_px, 0.0, lens.cx_px, lens.cy_px, *lens.distortion]
    calibrated = Lens(np.array(parameters), LensModel.BROWN)
    assert _sigma_mm(site, calibrated) == pytest.approx(apparent_mm, rel=0.15)
    assert _sigma_mm(site) == pytest.approx(apparent_mm, rel=0.4)


def test_a_lens_without_distortion_shows_no_turn() -> None:
    site = _site(sub_px_per_k=0.02)
    ideal = Lens.ideal(LensModel.RADIAL, site.sub.focal_px, site.sub.centre_px)
    assert turn_by_sub_shift(site, ideal) < 1e-12
    assert turn_by_sub_shift(site) > 1e-5


def test_the_sub_lens_is_named_where_it_is_the_largest_term() -> None:
    site = _site(sub_px_per_k=0.02, temperature_range_k=10.0)
    assert "come from the sub lens warming by 10.0 K" in season_sentence(site, 1.0, 0.001)
    still = replace(site, stability=replace(site.stability, sub_px_per_k=0.0))
    assert season_sentence(still, 1.0, 0.001).endswith("a row is as good as its pixels")
