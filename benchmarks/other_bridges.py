"""Bridges of another make than the analysis was fitted to: other noise, sun, sensors and gaps.

Nothing here is of the kind that the fits assume but the response to temperature itself. What a
figure says of `bridges` should hold here too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.bridges import BEGIN_S, DAY_S, Made, first_order, remembering
from core.arrays import FloatArray

_MINUTES = 1440
_BEFORE = 3 * _MINUTES
"""Minutes of weather before the record, so that a lag has a past."""
NOISES = ("many memories", "heavy tails", "flicker", "changing")
SENSORS = ((0.1, 0.0), (0.1, 0.0625), (0.03, 0.5), (0.0, 1.0), (0.3, 0.1), (0.0, 0.0))
"""Noise and step of a sensor, K: a resistance, a DS18B20, two of coarse steps, a poor one, none."""


@dataclass(frozen=True, slots=True)
class Other:
    """What such a bridge does; mm, days, hours."""

    days: float = 180.0
    every: int = 10
    """Minutes from row to row."""
    mm_per_kelvin: float = 0.25
    lag_h: float = 2.0
    first_order: bool = False
    noise: str = NOISES[0]
    sensor_k: float = 0.1
    sensor_step_k: float = 0.0
    step_day: float | None = None
    step_mm: float = 0.0
    drift_day: float | None = None
    drift_mm_per_year: float = 0.0
    gaps: bool = True
    """Of some days, one in 40 days; single rows are lost in any case."""


def some_other(seed: int, days: float = 180.0) -> Other:
    """One of 24 kinds: four noises, six sensors, either lag; rows of 1, 10 or 60 minutes."""
    rng = np.random.default_rng(31000 + seed)
    first_order = seed % 2 == 1
    sensor_k, step_k = SENSORS[seed % 6]
    return Other(
        days=days,
        every=(10, 10, 1, 60)[seed // 24 % 4],
        lag_h=float(rng.uniform(0.5, 8.0) if first_order else rng.uniform(-2.0, 4.0)),
        first_order=first_order,
        noise=NOISES[seed // 6 % 4],
        sensor_k=sensor_k,
        sensor_step_k=step_k,
    )


def make_other(bridge: Other, seed: int) -> Made:
    """Its rows."""
    rng = np.random.default_rng(seed)
    n = int(bridge.days * _MINUTES)
    deck = _deck(rng, n + _BEFORE)
    minutes = np.arange(-_BEFORE, n, dtype=np.float64)
    if bridge.first_order:
        behind = first_order(deck, bridge.lag_h)
    else:
        behind = np.interp(minutes - 60.0 * bridge.lag_h, minutes, deck)
    days = np.arange(n) / _MINUTES
    y_mm = bridge.mm_per_kelvin * behind[_BEFORE:] + _noise(bridge.noise, rng, n)
    if bridge.step_day is not None:
        y_mm += bridge.step_mm * (days >= bridge.step_day)
    if bridge.drift_day is not None:
        y_mm += bridge.drift_mm_per_year * np.maximum(days - bridge.drift_day, 0.0) / 365.25
    said = deck[_BEFORE:] + bridge.sensor_k * rng.normal(size=n)
    if bridge.sensor_step_k:
        said = bridge.sensor_step_k * np.round(said / bridge.sensor_step_k)
    keep = (rng.random(n) > 0.03) & (np.arange(n) % bridge.every == 0)
    if bridge.gaps:
        for begin in rng.integers(0, n, rng.poisson(bridge.days / 40.0)):
            keep[begin : begin + int(_MINUTES * rng.exponential(1.5))] = False
    return Made((BEGIN_S + 60.0 * np.arange(n))[keep], y_mm[keep], said[keep])


def _deck(rng: np.random.Generator, n: int) -> FloatArray:
    """(n,) of minutes: air of season, weather and day; on it the sun of clear and of cloudy hours.

    The sun shines by day alone, longer in summer, comes and goes with the clouds within minutes,
    and warms 0.2 m of deck whose surface forgets within 40 minutes.
    """
    days = (BEGIN_S / DAY_S) + (np.arange(n) - _BEFORE) / _MINUTES
    year = 2.0 * np.pi * (days / 365.25 - 0.3)
    air = 10.0 + 11.0 * np.sin(year) + remembering(rng, n, 3.5, 4.0 * _MINUTES)
    air += 3.0 * np.sin(2.0 * np.pi * (days - 0.4))
    height = np.sin(2.0 * np.pi * (days - 0.25)) + 0.35 * np.sin(year)
    clear = remembering(rng, n, 1.0, 1.2 * _MINUTES) + 0.8 * remembering(rng, n, 1.0, 25.0)
    sun = np.maximum(height, 0.0) * np.where(clear > 0.0, 1.0, 0.25)
    return air + 14.0 * first_order(sun, 40.0 / 60.0)


def _noise(kind: str, rng: np.random.Generator, n: int) -> FloatArray:
    """(n,) mm, of minutes."""
    found: FloatArray = 0.04 * rng.normal(size=n)
    match kind:
        case "many memories":
            for hours in (1.0, 6.0, 36.0, 192.0):
                found += remembering(rng, n, 0.01, 60.0 * hours)
        case "heavy tails":  # of rows, and of hours of haze
            found = 0.025 * rng.standard_t(3, size=n)
            hour = 0.02 * rng.standard_t(4, size=n // 60 + 1)
            found += np.repeat(hour, 60)[:n] + remembering(rng, n, 0.01, 5.0 * _MINUTES)
            bad = np.repeat(rng.random(n // 60 + 1) < 0.002, 60)[:n]
            found += 0.5 * bad * rng.choice([-1.0, 1.0])
        case "flicker":  # as many sizes as there are octaves, from minutes to a month
            for memory in (10.0 * 2.0 ** np.arange(13)).tolist():
                found += remembering(rng, n, 0.006, memory)
        case _:  # louder by day than by night, and in some weeks
            loud = 1.0 + 0.7 * np.sin(2.0 * np.pi * (np.arange(n) / _MINUTES - 0.3))
            loud = loud * np.exp(0.5 * remembering(rng, n, 1.0, 6.0 * _MINUTES))
            fast = remembering(rng, n, 0.015, 120.0)
            found = loud * (found + fast) + remembering(rng, n, 0.01, 4.0 * _MINUTES)
    return found
