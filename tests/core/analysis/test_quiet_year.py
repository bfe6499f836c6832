"""A year of a quiet bridge raises no alarm on the value; a millimetre beyond the level does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from core.analysis.alarm_rules import DAY_S, Limits, Samples, judge_level, judge_rate

STEP_S = 600.0
HOUR_S = 3600.0
SIGMA_MM = 0.15


@dataclass(frozen=True)
class Year:
    """A row every ten minutes, of those that are believed."""

    samples: Samples
    motion_mm: np.ndarray
    """(n,) what the bridge does, without noise."""

    def until(self, index: int, span_s: float) -> Samples:
        """The rows of a while up to one of them, and that one."""
        time_s = self.samples.time_s
        first = int(np.searchsorted(time_s, time_s[index] - span_s))
        part = slice(first, index + 1)
        return Samples(time_s[part], self.samples.value[part], self.samples.sigma[part])


@pytest.fixture(scope="module")
def year() -> Year:
    """Season, sun, weather of days and hours; noise with tails; nights, outages, dropped rows."""
    random = np.random.default_rng(5)
    time_s = np.arange(0.0, 365 * DAY_S, STEP_S)
    day = time_s / DAY_S
    season = 8.0 * np.sin(2 * np.pi * day / 365)
    sun = (1.5 + np.sin(2 * np.pi * day / 365)) * np.sin(2 * np.pi * (day - 0.35))
    weather = slow_noise(random, time_s.size, 3 * DAY_S, 0.8) + slow_noise(
        random, time_s.size, 2 * HOUR_S, 0.15
    )
    motion = season + sun + weather
    noise = SIGMA_MM * random.standard_t(6, time_s.size) * np.sqrt(4 / 6)
    kept = (day % 1 > 0.2) & (random.random(time_s.size) > 0.05)
    for start in random.uniform(0, 364, 12):
        kept &= ~((day > start) & (day < start + random.uniform(0.05, 4.0)))
    samples = Samples(time_s[kept], (motion + noise)[kept], np.full(int(kept.sum()), SIGMA_MM))
    return Year(samples, motion[kept])


def slow_noise(random: np.random.Generator, count: int, lasts_s: float, rms: float) -> np.ndarray:
    """Noise that forgets within a time."""
    from scipy.signal import lfilter

    memory = np.exp(-STEP_S / lasts_s)
    drive = random.normal(0, rms * np.sqrt(1 - memory**2), count)
    found: np.ndarray = lfilter([1.0], [1.0, -memory], drive)
    return found


def test_no_row_of_a_quiet_year_raises_a_level(year: Year) -> None:
    """The levels are where the bridge itself goes once a year: noise must not carry it over."""
    limits = Limits(year.motion_mm.max(), year.motion_mm.min(), 0.1, 3.0)
    beyond = raised = 0
    for index in range(3, year.samples.time_s.size, 2):
        value = year.samples.value[index]
        beyond += value > limits.above or value < limits.below
        judged = judge_level(year.until(index, HOUR_S), limits, 0.5 * HOUR_S, None)
        raised += judged is not None and judged.limit is not None
    assert beyond > 0  # single rows are beyond
    assert raised == 0


def test_a_millimetre_beyond_the_level_is_raised_within_the_dwell_time(year: Year) -> None:
    limits = Limits(year.motion_mm.max(), year.motion_mm.min(), 0.1, 3.0)
    random = np.random.default_rng(1)
    for index in random.integers(100, year.samples.time_s.size - 100, 200):
        rows = year.until(index + 5, 12 * HOUR_S)
        begin_s = year.samples.time_s[index]
        if rows.time_s[-1] - begin_s > 0.75 * HOUR_S:
            continue  # a gap follows
        noise = year.samples.value - year.motion_mm
        later = rows.time_s >= begin_s
        shift = noise[index : index + 6] + limits.above + 1.0
        moved = Samples(rows.time_s, np.concatenate([rows.value[~later], shift]), rows.sigma)
        judged = judge_level(moved, limits, HOUR_S, None)
        assert judged is not None
        assert judged.limit == limits.above


def test_no_hour_of_a_quiet_year_raises_a_rate(year: Year) -> None:
    """A limit that weather reaches in no window: 1.5 mm a day, over three days."""
    worst = raised = judged_windows = 0
    for index in range(432, year.samples.time_s.size, 24):
        rows = year.until(index, 3 * DAY_S)
        judged = judge_rate(rows, 1.5, 0.3, 3.0, 3 * DAY_S, raised=False)
        if judged is None:
            continue
        judged_windows += 1
        worst = max(worst, abs(judged.value))
        raised += judged.limit is not None
    assert judged_windows > 1000
    assert raised == 0
    assert worst < 1.5
