"""A calibration says which further motion would sharpen it most, for an engineer to act on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.calibration.calibrate import calibrate
from core.calibration.observability import drift_errors, suggest_motion
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.core.scenes import head_positions, small_site
from tests.core.sessions import Session, all_views


def test_small_turns_ask_for_a_roll() -> None:
    """Turns of a fifth of the reach leave the angle between the two axes open; a roll shows it."""
    site = small_site()
    world = World(site, SimSettings(seed=3))
    views = all_views(world, 5, 0.2 * head_positions(site, 6))
    calibration, report = calibrate(views, site)
    advice = suggest_motion(calibration.calibrated, site)
    assert advice is not None
    assert "rotation about z" in advice
    assert advice in report.lines


def test_a_sure_calibration_asks_for_nothing(field: Session) -> None:
    """Where another motion would not help, none is asked for."""
    calibrated = field.calibration.calibrated
    columns = calibrated.posterior.lens.shape[1]
    posterior = calibrated.posterior.transformed(1e-4 * np.eye(columns))
    sure = replace(calibrated, posterior=replace(posterior, own_mm2=1e-8 * posterior.own_mm2))
    assert max(error.calibration_mm for error in drift_errors(sure, field.site)) < 2e-3
    assert suggest_motion(sure, field.site) is None
