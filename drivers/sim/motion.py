"""How rig and bridge truly move: smooth functions of time, all from the seed."""

from __future__ import annotations

import math

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from drivers.sim.settings import ScenarioKind, SimSettings

WAVES = 4
"""Sines in one slow wander."""


class TrueMotion:
    """Rig drift and bridge displacement as functions of minutes since the start.

    Both are at rest but for their scenario windows, and ramp in and out of them smoothly.
    """

    def __init__(self, settings: SimSettings) -> None:
        rng = np.random.default_rng([settings.seed, 2])
        motion = settings.motion
        self._motion = motion
        self._scenarios = settings.scenarios
        self._amplitude = np.array([motion.drift_mrad / 1000.0] * 3 + [motion.drift_mm] * 3)
        weights = rng.uniform(0.5, 1.0, (6, WAVES))
        self._weights = weights / weights.sum(axis=1, keepdims=True)
        self._omega = (
            2.0 * math.pi / (motion.drift_period_min * np.exp(rng.uniform(-0.9, 0.9, (6, WAVES))))
        )
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (6, WAVES))
        self._small_omega = 2.0 * math.pi / rng.uniform(3.0, 17.0, (2, WAVES))
        self._small_phase = rng.uniform(0.0, 2.0 * math.pi, (2, WAVES))

    def drift(self, minute: float) -> Pose:
        """`T_CSj_CS1` of the drift alone: within +-amplitude about and along each axis."""
        waves = np.sum(self._weights * np.sin(self._omega * minute + self._phase), axis=1)
        vector = self._envelope("drift", minute) * self._amplitude * waves
        return Pose.from_vectors(vector[:3], vector[3:])

    def bridge_mm(self, minute: float) -> FloatArray:
        """(3,) displacement of the main target in WM: a slow wave up and down, small fast ones."""
        motion = self._motion
        slow = motion.bridge_daily_mm * math.sin(2.0 * math.pi * minute / motion.bridge_period_min)
        fast = np.mean(np.sin(self._small_omega * minute + self._small_phase), axis=1)
        x, y = np.array([0.1 * slow, slow]) + motion.bridge_small_mm * fast
        moved = self._envelope("bridge", minute) * np.array([x, y, 0.0])
        return np.asarray(moved + np.array([0.0, self._course_mm(minute), 0.0]))

    def _course_mm(self, minute: float) -> float:
        course = np.array(self._motion.bridge_course).reshape(-1, 2)
        return float(np.interp(minute, course[:, 0], course[:, 1])) if len(course) else 0.0

    def _envelope(self, kind: ScenarioKind, minute: float) -> float:
        """1 inside the windows of a kind, 0 outside, a smooth ramp at their edges."""
        ramp_min = max(self._motion.ramp_min, 1e-9)
        inside = (s.minutes_inside(minute) for s in self._scenarios if s.kind == kind)
        return max((_smooth(min(edges) / ramp_min) for edges in inside if edges), default=0.0)


def _smooth(x: float) -> float:
    """Rise from 0 at 0 to 1 at 1 with no jump in slope."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
