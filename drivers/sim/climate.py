"""How warm air and cameras truly are: sums of sines, so that any instant can be asked for alone."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np

from drivers.protocols import Role
from drivers.sim.settings import SimSettings

DAY_S = 86_400.0
YEAR_S = 365.25 * DAY_S
WARMEST_UTC = datetime(2026, 7, 21, tzinfo=UTC)
"""When the yearly wave has its crest: half a year after 20 January."""
WEATHER_WAVES = 24
"""Sines that the weather is made of."""
WEATHER_SPREAD = 1.5
"""Their periods are within a factor e to this of the middle one."""


class TrueClimate:
    """Temperatures as functions of time, all from the seed."""

    def __init__(self, settings: SimSettings) -> None:
        climate = settings.climate
        self._climate = climate
        self._seed = settings.seed
        rng = np.random.default_rng([settings.seed, 9])
        spread = rng.uniform(-WEATHER_SPREAD, WEATHER_SPREAD, WEATHER_WAVES)
        weather_k = climate.air_weather_k * math.sqrt(2.0 / WEATHER_WAVES)
        weather_s = climate.weather_days * DAY_S * np.exp(spread)
        crest_s = WARMEST_UTC.timestamp()
        day_phase = -math.tau * climate.warmest_hour_utc / 24.0
        self._amplitude_k = np.array(
            [climate.air_daily_k, climate.air_seasonal_k, *np.full(WEATHER_WAVES, weather_k)]
        )
        self._omega = math.tau / np.array([DAY_S, YEAR_S, *weather_s])
        self._phase = np.array(
            [day_phase, -math.tau * crest_s / YEAR_S, *rng.uniform(0.0, math.tau, WEATHER_WAVES)]
        )

    def air_c(self, t_utc: datetime) -> float:
        """Temperature of the air, and of the board on the pier."""
        return self._waves_c(t_utc, 0.0)

    def camera_c(self, role: Role, t_utc: datetime) -> float:
        """Temperature of a camera: it follows the air as a first-order lag, above it."""
        climate = self._climate
        above_k = climate.main_above_air_k if role == "main" else climate.sub_above_air_k
        return self._waves_c(t_utc, climate.camera_lag_h * 3600.0) + above_k

    def reported_c(self, role: Role, true_c: float, moment_utc: datetime) -> float:
        """What a camera says of its temperature in the frame of this moment."""
        noise_k = self._climate.sensor_noise_k
        if noise_k > 0.0:
            moment_us = round(moment_utc.timestamp() * 1e6)
            rng = np.random.default_rng([self._seed, 10, role == "sub", moment_us])
            true_c += noise_k * rng.standard_normal()
        return round(true_c, 2)

    def day_wave(self, t_utc: datetime) -> float:
        """1 at the warmest hour of the day, -1 at the coldest."""
        return math.cos(self._omega[0] * t_utc.timestamp() + self._phase[0])

    def _waves_c(self, t_utc: datetime, lag_s: float) -> float:
        """Mean and waves; behind a lag each is lower and later, by 1 / (1 + i omega lag)."""
        behind = self._omega * lag_s
        wave = np.cos(self._omega * t_utc.timestamp() + self._phase - np.arctan(behind))
        lower = self._amplitude_k / np.hypot(1.0, behind)
        return self._climate.air_mean_c + float(lower @ wave)
