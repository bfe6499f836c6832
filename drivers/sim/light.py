"""How much light falls on each camera's target: slow change by day, and the nights."""

from __future__ import annotations

import math

from drivers.protocols import Role
from drivers.sim.settings import SimSettings


class TrueLight:
    """Light as a function of minutes since the start."""

    def __init__(self, settings: SimSettings) -> None:
        self._settings = settings

    def of(self, role: Role, minute: float) -> float:
        """Give the light before a camera; 1 is what the scene's grey values are given for."""
        optics, seed = self._settings.optics, self._settings.seed
        dark = self._darkness(role, minute)
        if dark > 0.0:
            return float(optics.night_light**dark)
        phase = 0.3 * seed + (1.0 if role == "main" else 0.0)
        return 1.0 + optics.light_change * math.sin(minute / 37.0 + phase)

    def _darkness(self, role: Role, minute: float) -> float:
        """How far the night has come: 0 is day, 1 night; the light falls by its share of a power.

        A lamp that fails takes no time; the sun takes `dusk_min` to set and to rise.
        """
        dusk_min = self._settings.optics.dusk_min
        deepest = 0.0
        for scenario in self._settings.scenarios:
            inside = scenario.minutes_inside(minute)
            if scenario.kind != "night" or inside is None or not scenario.strikes(role):
                continue
            deepest = max(deepest, min(1.0, *(m / dusk_min for m in inside)) if dusk_min else 1.0)
        return deepest
