"""One axis of a simulated head: finite speed and acceleration, in the time that it is given."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class _Phase:
    """A span of constant acceleration."""

    seconds: float
    accel_deg_s2: float


class Axis:
    """Where an axis is at any time; every order is given with the time at which it is given.

    Time never goes back. A move is a trapezoid of speed: up, along, down. An axis that must
    go elsewhere while it moves the wrong way, or too fast, brakes to a stop first.
    """

    def __init__(
        self, limits_deg: tuple[float, float], speed_deg_s: float, accel_deg_s2: float
    ) -> None:
        self.limits_deg = limits_deg
        self.speed_deg_s = speed_deg_s
        self.accel_deg_s2 = accel_deg_s2
        self.target_deg = 0.0
        self._start_s = 0.0
        self._start_deg = 0.0
        self._start_deg_s = 0.0
        self._phases: tuple[_Phase, ...] = ()
        self._jammed = False

    def go(self, target_deg: float, now_s: float, speed_deg_s: float | None = None) -> None:
        """Go there, as fast as asked or as the axis is set to; never beyond its mechanical end."""
        low, high = self.limits_deg
        self._begin_here(now_s)
        self.target_deg = min(max(target_deg, low), high)
        speed = self.speed_deg_s if speed_deg_s is None else speed_deg_s
        if self._jammed:
            return
        if speed <= 0.0:
            self.stop(now_s)
            return
        phases: list[_Phase] = []
        at_deg, rate = self._start_deg, self._start_deg_s
        accel = self.accel_deg_s2
        brake_deg = rate * abs(rate) / (2.0 * accel)
        way_deg = self.target_deg - at_deg
        too_late = rate * way_deg < 0.0 or abs(brake_deg) > abs(way_deg)
        if rate != 0.0 and (too_late or abs(rate) > speed):
            phases.append(_Phase(abs(rate) / accel, -math.copysign(accel, rate)))
            at_deg, rate = at_deg + brake_deg, 0.0
            way_deg = self.target_deg - at_deg
        sign = math.copysign(1.0, way_deg)
        top = min(speed, math.sqrt(accel * abs(way_deg) + rate * rate / 2.0))
        up_s, down_s = (top - abs(rate)) / accel, top / accel
        along_deg = abs(way_deg) - (top + abs(rate)) / 2.0 * up_s - top / 2.0 * down_s
        phases += [
            _Phase(up_s, sign * accel),
            _Phase(max(along_deg, 0.0) / top if top > 0.0 else 0.0, 0.0),
            _Phase(down_s, -sign * accel),
        ]
        self._phases = tuple(phases)

    def stop(self, now_s: float) -> None:
        """Brake to a stop."""
        self._begin_here(now_s)
        rate = self._start_deg_s
        if rate != 0.0:
            accel = self.accel_deg_s2
            self._phases = (_Phase(abs(rate) / accel, -math.copysign(accel, rate)),)
        self.target_deg = self._start_deg + rate * abs(rate) / (2.0 * self.accel_deg_s2)

    def jam(self, now_s: float) -> None:
        """Be blocked from now on: it stands still whatever it is asked."""
        self._begin_here(now_s)
        self._start_deg_s = 0.0
        self._jammed = True

    def at_deg(self, now_s: float) -> float:
        """Where it is."""
        return self._state(now_s)[0]

    def rate_deg_s(self, now_s: float) -> float:
        """How fast it turns."""
        return self._state(now_s)[1]

    def moves(self, now_s: float) -> bool:
        """Whether it still turns."""
        return now_s < self._start_s + sum(phase.seconds for phase in self._phases)

    def _begin_here(self, now_s: float) -> None:
        self._start_deg, self._start_deg_s = self._state(now_s)
        self._start_s, self._phases = now_s, ()

    def _state(self, now_s: float) -> tuple[float, float]:
        if self._phases and not self.moves(now_s):
            return self.target_deg, 0.0  # to the last bit, whatever the sums of the phases say
        at_deg, rate, left_s = self._start_deg, self._start_deg_s, now_s - self._start_s
        for phase in self._phases:
            t = min(left_s, phase.seconds)
            at_deg += rate * t + phase.accel_deg_s2 * t * t / 2.0
            rate += phase.accel_deg_s2 * t
            left_s -= t
            if left_s <= 0.0:
                break
        return at_deg, rate
