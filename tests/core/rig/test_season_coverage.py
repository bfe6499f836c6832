"""Twenty seasons of rigs that bend at random: without a fixed target the sigma holds it."""

from __future__ import annotations

from datetime import timedelta

import numpy as np

from core.moment import Moment
from core.rig.stability import stability_terms
from core.site import CameraGeometry
from drivers.sim.settings import Breathing, Climate, SimSettings
from drivers.sim.world import World
from tests.core.scenes import small_site

SEASONS, ROWS, DAYS = 20, 14, 145.0
PIXELS_MM = 0.01
"""1 sigma by pixels and calibration, as at 22 m."""


def test_two_thirds_of_the_errors_of_a_season_are_within_its_sigma() -> None:
    """2 urad/K, 14 urad of creep and 0.02 px/K, each in a direction of its own."""
    site = small_site(
        22000.0,
        main=CameraGeometry(1920, 1200, 5.86, 800.0),
        sub=CameraGeometry(1920, 1200, 5.86, 6.0),
    )
    scale = site.nominal_px_per_mm
    rng = np.random.default_rng(1)
    ratios = []
    for seed in range(SEASONS):
        turn, shift = rng.uniform(0.0, 2.0 * np.pi, 2)
        settings = SimSettings(
            seed=seed,
            climate=Climate(air_daily_k=6, air_seasonal_k=12, air_weather_k=3, camera_lag_h=1),
            breathing=Breathing(
                cameras_urad_per_k=(2.0 * np.cos(turn), 2.0 * np.sin(turn), 0.5),
                cameras_urad_per_sqrt_day=(1.17, 1.17, 0.3),
                main_px_per_k=(0.02 * np.cos(shift), 0.02 * np.sin(shift)),
            ),
        )
        world = World(site, settings, renders=False)
        begin = settings.start_utc - timedelta(minutes=30)
        reference = Moment(begin.timestamp(), world.reported_c("main", begin))
        for row in range(ROWS):
            hours = float(rng.uniform(0.0, 24.0))
            now = settings.start_utc + timedelta(days=DAYS * (row + 0.3) / ROWS, hours=hours)
            moment = Moment(now.timestamp(), world.reported_c("main", now))
            terms = stability_terms(site, scale, reference, moment)
            state = sum(np.diag(term.covariance) for term in terms)
            sigma_mm = np.hypot(np.sqrt(state[:2] + state[4:]) / scale, PIXELS_MM)
            ratios.append(np.asarray(world.truth(now).shift_px) / scale / sigma_mm)
    away = np.abs(np.array(ratios))
    assert 0.55 < (away < 1.0).mean() < 0.85
    assert (away < 2.0).mean() > 0.9
