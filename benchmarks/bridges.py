"""Records of known make: bridges with temperature, lag, trend, steps, creep, gaps and noise."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement, Flag, Measurement
from daemon.store.database import open_store
from daemon.store.integrity.checksum_columns import row_digests
from daemon.store.records import MeasurementRecord, Reading
from daemon.times import EPOCH, instant_text, slot_text

BEGIN_S = 1.7723232e9
"""2026-03-01T00:00:00Z."""
DAY_S = 86400.0
_MINUTES = 1440
_BEFORE_DAYS = 2
"""Days of temperature before the record, so that a lag has a past."""


def remembering(rng: np.random.Generator, n: int, sigma: float, memory: float) -> FloatArray:
    """(n,) Ornstein-Uhlenbeck noise with its memory in steps."""
    from scipy.signal import lfilter

    left = np.exp(-1.0 / memory)
    noise = rng.normal(size=n) * sigma * np.sqrt(1.0 - left * left)
    noise[0] = rng.normal() * sigma
    found: FloatArray = lfilter([1.0], [1.0, -left], noise)
    return found


@dataclass(frozen=True, slots=True)
class Bridge:
    """What a bridge does, and how well it is measured; mm, days, hours."""

    days: float = 365.0
    mm_per_kelvin: float = 0.25
    lag_h: float = 2.0
    first_order: bool = False
    slow_share: float = 0.0
    """Of the response that comes through a second mass, behind `slow_h` instead."""
    slow_h: float = 24.0
    unseen_mm: float = 0.0
    """Standard deviation of what a warmth that no sensor shows does, of the sun and clouds."""
    trend_mm_per_year: float = 0.0
    step_day: float | None = None
    step_mm: float = 0.0
    drift_day: float | None = None
    drift_mm_per_year: float = 0.0
    white_mm: float = 0.04
    """Of a row."""
    fast_mm: float = 0.02
    fast_minutes: float = 90.0
    slow_mm: float = 0.01
    slow_days: float = 5.0
    lost: float = 0.02
    """Share of single rows without a value."""
    outages: float = 0.1
    """Failures of the lamp a day, of 8 hours on average."""
    every: int = 1
    """Minutes from row to row."""
    sensor_k: float = 0.1
    """Noise of a reading of the temperature."""
    sensor_step_k: float = 0.0
    """What a reading is rounded to; 0: to nothing."""
    sensor_h: float = 0.0
    """First-order lag of the sensor itself, in concrete or in a box; the bridge is behind it."""


@dataclass(frozen=True, slots=True)
class Made:
    """Good rows of a bridge."""

    times_s: FloatArray
    y_mm: FloatArray
    deck_c: FloatArray
    """What the sensor says, with its noise and steps."""


def make(bridge: Bridge, seed: int) -> Made:
    """Rows of a bridge, where there is one."""
    rng = np.random.default_rng(seed)
    n = int(bridge.days * _MINUTES)
    deck, behind = _temperatures(bridge, rng, n)
    days = np.arange(n) / _MINUTES
    y_mm = bridge.mm_per_kelvin * behind + bridge.white_mm * rng.normal(size=n)
    y_mm += remembering(rng, n, bridge.fast_mm, bridge.fast_minutes)
    y_mm += remembering(rng, n, bridge.slow_mm, bridge.slow_days * _MINUTES)
    y_mm += bridge.trend_mm_per_year * days / 365.25
    if bridge.unseen_mm:
        clouds = 1.0 + remembering(rng, n, 0.7, 1.5 * _MINUTES)
        y_mm += bridge.unseen_mm * np.sqrt(2.0) * clouds * np.sin(2.0 * np.pi * (days - 0.3))
    if bridge.step_day is not None:
        y_mm += bridge.step_mm * (days >= bridge.step_day)
    if bridge.drift_day is not None:
        y_mm += bridge.drift_mm_per_year * np.maximum(days - bridge.drift_day, 0.0) / 365.25
    spikes = rng.random(n) < 2e-4  # a bird on the target that nobody noticed
    y_mm[spikes] += 3.0 * rng.normal(size=int(spikes.sum()))
    keep = rng.random(n) >= bridge.lost
    for _ in range(rng.poisson(bridge.outages * bridge.days)):
        begin = int(rng.integers(n))
        keep[begin : begin + int(rng.exponential(8 * 60))] = False
    said = deck + bridge.sensor_k * rng.normal(size=n)
    if bridge.sensor_step_k:
        said = bridge.sensor_step_k * np.round(said / bridge.sensor_step_k)
    keep &= np.arange(n) % bridge.every == 0
    return Made((BEGIN_S + 60.0 * np.arange(n))[keep], y_mm[keep], said[keep])


def _temperatures(
    bridge: Bridge, rng: np.random.Generator, n: int
) -> tuple[FloatArray, FloatArray]:
    """Deck temperature of season, weather and sun, and the same behind the lag."""
    before = _BEFORE_DAYS * _MINUTES
    hours = np.arange(-before, n) / 60.0
    days = BEGIN_S / DAY_S + hours / 24.0
    weather = remembering(rng, n + before, 4.0, 3.0 * _MINUTES)
    sun = np.clip(0.5 + remembering(rng, n + before, 0.35, 2.0 * _MINUTES), 0.05, 1.2)
    season = 10.0 + 12.0 * np.sin(2.0 * np.pi * (days / 365.25 - 0.3))
    deck = season + weather + 6.0 * sun * np.sin(2.0 * np.pi * (days - 0.35))
    deck += remembering(rng, n + before, 0.5, 60.0)
    if bridge.sensor_h:
        deck = first_order(deck, bridge.sensor_h)
    if bridge.first_order:
        behind = first_order(deck, bridge.lag_h)
    else:
        behind = np.interp(hours - bridge.lag_h, hours, deck)
    slow = first_order(deck, bridge.slow_h)
    behind = (1.0 - bridge.slow_share) * behind + bridge.slow_share * slow
    return deck[before:], behind[before:]


def first_order(values: FloatArray, lag_h: float) -> FloatArray:
    """Values of minutes behind a first-order lag; exact for lines from minute to minute."""
    from scipy.signal import lfilter

    step = 1.0 / 60.0 / lag_h
    left = np.exp(-step)
    now = 1.0 - (1.0 - left) / step
    found: FloatArray = lfilter([now, 1.0 - left - now], [1.0, -left], values - values[0])
    found += values[0]
    return found


CREEP_LAWS = ("logarithmic", "power", "double-exponential", "eurocode2", "aci209", "b3")
OTHER_CREEP = ("mc2010", "mixture")
"""What none of the laws that are fitted follows exactly."""


CREEP_NOISES = ("days", "white", "tails", "weeks")
"""Noise that remembers 1 to 5 days; that remembers nothing; of heavy tails beside a day's memory;
that remembers 3 to 10 days, with a season that nothing explains. The last two have gaps of days."""


def make_creep(
    law: str, seed: int, noise: str = "days", days: int = 90
) -> tuple[FloatArray, FloatArray, float]:
    """Times (n,) and hourly values (n,) since loading at BEGIN_S, and the true level on day 365.

    `law` is one of `CREEP_LAWS` or `OTHER_CREEP`, `noise` one of `CREEP_NOISES`. Shapes are drawn
    evenly within the laws' usual bounds, 3 to 15 mm of creep.
    """
    rng = np.random.default_rng(seed)
    hours = np.arange(366 * 24) / 24.0
    course = creep_course(law, rng, hours, days)
    course += 5.0 * rng.normal()
    n = days * 24
    values = course[:n] + _creep_noise(noise, rng, n)
    keep = rng.random(n) > 0.1
    if noise in {"tails", "weeks"}:
        for begin in rng.integers(24, n, rng.poisson(3)):
            keep[begin : begin + int(24.0 * rng.exponential(3.0))] = False
    return BEGIN_S + hours[:n][keep] * DAY_S, values[keep], float(course[365 * 24])


def creep_course(law: str, rng: np.random.Generator, at_days: FloatArray, by: int) -> FloatArray:
    """Creep (n,), mm, at days since loading: 3 to 15 mm by one of them, shape drawn evenly."""
    found = _course(law, rng, at_days)
    size_mm = rng.uniform(3.0, 15.0) * rng.choice([-1.0, 1.0])
    return np.asarray(found * (size_mm / np.interp(by, at_days, found)))


def _creep_noise(noise: str, rng: np.random.Generator, n: int) -> FloatArray:
    """(n,) of hours."""
    match noise:
        case "white":
            return rng.uniform(0.02, 0.2) * rng.normal(size=n)
        case "tails":
            return 0.03 * rng.standard_t(3, size=n) + remembering(rng, n, 0.1, 24.0)
        case "weeks":
            found = 0.05 * rng.normal(size=n)
            found += remembering(rng, n, rng.uniform(0.05, 0.2), 24.0 * rng.uniform(3.0, 10.0))
            season = np.sin(2.0 * np.pi * (np.arange(n) / 24.0 / 365.25 - rng.random()))
            return found + rng.uniform(0.02, 0.1) * season
        case _:
            found = 0.02 * rng.normal(size=n) + remembering(rng, n, 0.03, 2.0)
            return found + remembering(rng, n, rng.uniform(0.02, 0.1), 24.0 * rng.uniform(1.0, 5.0))


def _course(law: str, rng: np.random.Generator, days: FloatArray) -> FloatArray:
    def by_ratio(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    found: FloatArray
    match law:
        case "logarithmic":
            found = np.log1p(days / by_ratio(0.1, 60.0))
        case "power":
            found = days ** rng.uniform(0.05, 0.9)
        case "eurocode2":
            found = (days / (rng.uniform(250.0, 1500.0) + days)) ** 0.3
        case "aci209":
            grown = days ** rng.uniform(0.4, 0.8)
            found = grown / (rng.uniform(6.0, 30.0) + grown)
        case "mc2010":  # none of the laws that are fitted: basic and drying creep together
            basic = rng.uniform(0.1, 0.4) * np.log1p((30.0 / 28.0 + 0.035) ** 2 * days)
            drying = (days / (rng.uniform(300.0, 1500.0) + days)) ** (1.0 / (2.3 + 3.5 / 28.0**0.5))
            found = basic + drying
        case "b3":  # Bazant & Baweja, at a humidity of 50 to 80 %
            basic = np.log1p(days**0.1)
            dried = np.tanh(np.sqrt(days / by_ratio(100.0, 2000.0)))
            drying = np.sqrt(np.expm1(8.0 * rng.uniform(0.2, 0.5) * dried))
            share = rng.uniform(0.2, 0.8)
            found = share * basic / basic[90 * 24] + (1.0 - share) * drying / drying[90 * 24]
        case "mixture":  # of three of the laws, in shares that are all equally likely
            shares = rng.dirichlet(np.ones(3))
            laws = rng.choice(CREEP_LAWS, 3, replace=False)
            parts = [_course(str(law), rng, days) for law in laws]
            found = np.sum([s * p / p[90 * 24] for s, p in zip(shares, parts, strict=True)], axis=0)
        case _:
            share = rng.uniform(0.1, 0.9)
            fast, slow = by_ratio(1.0, 30.0), by_ratio(40.0, 1500.0)
            found = -share * np.expm1(-days / fast) - (1.0 - share) * np.expm1(-days / slow)
    return found


def _first(slot: datetime, made: Made) -> MeasurementRecord:
    displacement = Displacement(np.array([0.5, made.y_mm[0]]), np.diag([0.01, 0.04]))
    measurement = Measurement(Flag.GOOD, (), displacement, displacement, None)
    return MeasurementRecord(
        slot,
        measurement,
        *("0123456789ab", "0.1.0"),
        captured_utc=slot,
        readings=(Reading("deck", "degC", float(made.deck_c[0])),),
    )


def write_record(state: Path, made: Made) -> None:
    """Write the rows into a new state, each as the daemon would, with a reading `deck`."""
    with open_store(state) as store:
        when = [EPOCH + timedelta(seconds=int(time_s)) for time_s in made.times_s]
        store.add_measurement(_first(when[0], made))
        with closing(sqlite3.connect(store.path)) as connection, connection:
            cursor = connection.execute("SELECT * FROM measurement")
            names = [column[0] for column in cursor.description]
            first = dict(zip(names, cursor.fetchone(), strict=True))
            insert = ", ".join(names), ", ".join("?" * len(names))
            for begin in range(1, len(when), 5000):
                places = range(begin, min(begin + 5000, len(when)))
                columns: dict[str, Sequence[Any]] = {
                    name: [value] * len(places) for name, value in first.items()
                }
                columns["id"] = [place + 1 for place in places]
                columns["slot_utc"] = [slot_text(when[place]) for place in places]
                columns["captured_utc"] = [instant_text(when[place]) for place in places]
                columns["y_mm"] = made.y_mm[places].tolist()
                columns["readings"] = [
                    json.dumps({"deck": [made.deck_c[place], "degC"]}, separators=(",", ":"))
                    for place in places
                ]
                columns["digest"] = row_digests("measurement", columns)
                connection.executemany(
                    f"INSERT INTO measurement ({insert[0]}) VALUES ({insert[1]})",
                    zip(*(columns[name] for name in names), strict=True),
                )
