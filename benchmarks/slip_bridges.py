"""Bridges, rigs and their noise as numbers, row by row: what `benchmarks.slip` is tried on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.quality.row_series import Quantity, RowSeries

SIGMA_MM = 0.01
"""Of a corrected displacement and of a false one."""
DAY = 1440


@dataclass(frozen=True, slots=True)
class Motion:
    """What rig and bridge truly do, and the noise: n rows."""

    time_s: FloatArray
    """(n,)."""
    turn_mm: FloatArray
    """(n, 2) false displacement by the rig's rotation."""
    slide_mm: FloatArray
    """(n, 2) by its translation."""
    bridge_mm: FloatArray
    """(n, 2)."""
    sigma_mm: FloatArray
    """(n,) that the rows claim."""
    noise_mm: FloatArray
    """(n, 2) of the sub-camera's pose: in the false displacement, and opposed in the corrected."""

    def rows(self, slip_mm: FloatArray | None = None) -> RowSeries:
        """The rows that are measured, the board having slipped by (n, 2)."""
        slip_mm = np.zeros_like(self.bridge_mm) if slip_mm is None else slip_mm
        slide_mm = self.slide_mm + slip_mm
        values: dict[Quantity, FloatArray] = {
            "mm": self.bridge_mm - slip_mm - self.noise_mm,
            "false_mm": self.turn_mm + slide_mm + self.noise_mm,
            "slide_mm": slide_mm + 0.3 * self.noise_mm,
        }
        sigmas = dict.fromkeys(values, self.sigma_mm)
        return RowSeries.of_columns(self.time_s, values, sigmas, np.ones(len(slip_mm)))


Simulate = Callable[[np.random.Generator, int], Motion]


def waves(rng: np.random.Generator, minutes: FloatArray, size: float, ratio: float) -> FloatArray:
    """A day's warmth (n, 2), other each day, x and y in this ratio."""
    day = 2.0 * np.pi * minutes / DAY
    strength = np.interp(minutes, *_daily(rng, minutes))
    shape = np.sin(day) + 0.3 * np.sin(2.0 * day + rng.uniform(0.0, 6.0))
    return np.asarray(size * (strength * shape)[:, None] * np.array([ratio, 1.0]))


def _daily(rng: np.random.Generator, minutes: FloatArray) -> tuple[FloatArray, FloatArray]:
    noons = np.arange(minutes[0], minutes[-1] + 2 * DAY, DAY)
    return noons, rng.uniform(0.2, 1.0, len(noons))


def relaxing(rng: np.random.Generator, n: int, minutes: float, size: float) -> FloatArray:
    """An Ornstein-Uhlenbeck process (n, 2) of this time constant and standard deviation."""
    keep = np.exp(-1.0 / minutes)
    drawn = rng.standard_normal((n, 2)) * size * np.sqrt(1.0 - keep**2)
    return _adding_up(drawn, keep)


def clouds(rng: np.random.Generator, n: int, every: float, minutes: float) -> FloatArray:
    """Warmth (n,) of steel when clouds come and go: steps of the sun, followed slowly."""
    light = np.cumsum(rng.random(n) < 1.0 / every) % 2
    keep = np.exp(-1.0 / minutes)
    return _adding_up((1.0 - keep) * light, keep)


def _adding_up(drawn: FloatArray, keep: float) -> FloatArray:
    """What is drawn (n, ...), and of what was there a step before so much."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -keep], drawn, axis=0))


def noise(rng: np.random.Generator, sigma_mm: FloatArray, factor: float = 1.0) -> FloatArray:
    """Noise (n, 2) of the pose, `factor` times what the rows claim."""
    return factor * sigma_mm[:, None] * rng.standard_normal((len(sigma_mm), 2))


def _minutely(
    rng: np.random.Generator,
    rig: tuple[FloatArray, FloatArray],
    bridge_mm: FloatArray,
    factor: float = 1.0,
) -> Motion:
    n = len(bridge_mm)
    sigma_mm = np.full(n, SIGMA_MM)
    return Motion(60.0 * np.arange(n), *rig, bridge_mm, sigma_mm, noise(rng, sigma_mm, factor))


def _calm_rig(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    minutes = np.arange(float(n))
    turn = waves(rng, minutes, 3.0, 0.7) + relaxing(rng, n, 300.0, 0.3)
    return turn, waves(rng, minutes, 0.3, 0.7) + relaxing(rng, n, 300.0, 0.03)


def quiet(rng: np.random.Generator, n: int) -> Motion:
    """A stiff bridge: 0.02 mm of vibration, 1 mm of warmth a day."""
    bridge = waves(rng, np.arange(float(n)), 1.0, 0.1) + 0.02 * rng.standard_normal((n, 2))
    return _minutely(rng, _calm_rig(rng, n), bridge)


def vibrating(rng: np.random.Generator, n: int) -> Motion:
    """A lively one: white vibration of 0.3 mm, a third of it sideways."""
    moves = 0.3 * rng.standard_normal((n, 2)) * np.array([0.3, 1.0])
    return _minutely(rng, _calm_rig(rng, n), waves(rng, np.arange(float(n)), 5.0, 0.1) + moves)


def traffic(rng: np.random.Generator, n: int) -> Motion:
    """Lorries (Student's t of 3, 0.3 mm), queues that last (AR 0.8), trains (3 mm, two rows)."""
    shape = np.array([0.2, 1.0])
    lorries = 0.3 * rng.standard_t(3, (n, 2)) * shape
    queues = relaxing(rng, n, 4.5, 0.4) * shape
    train = np.convolve(rng.random(n) < 0.02, [1.0, 1.0])[:n, None] * np.array([0.3, -3.0])
    warmth = waves(rng, np.arange(float(n)), 5.0, 0.1)
    return _minutely(rng, _calm_rig(rng, n), warmth + lorries + queues + train)


def opposed_warmth(rng: np.random.Generator, n: int) -> Motion:
    """Sun and clouds drive rig (12 mm a day) and bridge (8 mm) against each other."""
    minutes = np.arange(float(n))
    day = waves(rng, minutes, 1.0, 0.5)
    sun = np.clip(day, 0.0, None)
    rig = -12.0 * day - 3.0 * clouds(rng, n, 90.0, 12.0)[:, None] * sun
    bridge = 8.0 * day + 2.5 * clouds(np.random.default_rng(7), n, 90.0, 15.0)[:, None] * sun
    slide = 0.1 * rig + relaxing(rng, n, 300.0, 0.03)
    return _minutely(rng, (rig, slide), bridge + 0.05 * rng.standard_normal((n, 2)))


def gusts(rng: np.random.Generator, n: int) -> Motion:
    """Storms of hours, gusts with tails of t 3 that shake rig and bridge in the same rows."""
    storm = np.exp(1.5 * relaxing(rng, n, 180.0, 1.0)[:, :1])
    pushes = storm * relaxing(rng, n, 8.0, 1.0) * np.array([1.0, 0.4])
    rig = 0.05 * storm * rng.standard_t(3, (n, 2)) + 0.05 * pushes
    bridge = 0.1 * storm * rng.standard_t(3, (n, 2)) - 0.2 * pushes
    turn, slide = _calm_rig(rng, n)
    return _minutely(rng, (turn + rig, slide + 0.1 * rig), bridge)


def sunny_rig(rng: np.random.Generator, n: int) -> Motion:
    """A rig that walks at random (0.05 mm a row), in waves of 15 mm; noise 1.5 times its sigma."""
    minutes = np.arange(float(n))
    steps = relaxing(rng, n, 2000.0, 0.05 * np.sqrt(1000.0))
    turn = waves(rng, minutes, 15.0, 0.7) + steps
    slide = waves(rng, minutes, 1.5, 0.7) + 0.1 * steps
    bridge = waves(rng, minutes, 5.0, 0.1) + 0.1 * rng.standard_t(4, (n, 2))
    return _minutely(rng, (turn, slide), bridge, 1.5)


def nights(rng: np.random.Generator, n: int) -> Motion:
    """As `traffic`; nights dark, their edges five times as noisy; outages at random."""
    m = int(1.8 * n) + DAY
    motion = traffic(rng, m)
    hour = motion.time_s / 3600.0 % 24.0
    lit = (hour > 5.0) & (hour < 19.0)
    dim = (hour < 7.0) | (hour > 17.0)
    outage = np.convolve(rng.random(m) < 1.0 / 3000.0, np.ones(30))[:m] > 0.5
    sigma_mm = np.where(dim, 5.0, 1.0) * SIGMA_MM
    keep = np.flatnonzero(lit & ~outage)[:n]
    return Motion(
        motion.time_s[keep],
        motion.turn_mm[keep],
        motion.slide_mm[keep],
        motion.bridge_mm[keep],
        sigma_mm[keep],
        noise(rng, sigma_mm)[keep],
    )


def hourly(rng: np.random.Generator, n: int) -> Motion:
    """A row an hour at 22 m: 22 mm of drift, 5 mm of bridge a day, lorries and queues."""
    minutes = 60.0 * np.arange(n)
    turn = waves(rng, minutes, 22.0, 0.7) + relaxing(rng, n, 10.0, 3.0)
    slide = waves(rng, minutes, 1.5, 0.7) + relaxing(rng, n, 10.0, 0.3)
    bridge = waves(rng, minutes, 5.0, 0.1) + 0.3 * rng.standard_t(3, (n, 2))
    sigma_mm = np.full(n, SIGMA_MM)
    return Motion(60.0 * minutes, turn, slide, bridge, sigma_mm, noise(rng, sigma_mm))


def touched(rng: np.random.Generator, n: int) -> Motion:
    """As `traffic`, and once a week somebody knocks the rig by millimetres, for good."""
    motion = traffic(rng, n)
    knocked = rng.random((n, 1)) < 1.0 / (7 * DAY)
    knocks = np.cumsum(knocked * rng.normal(0.0, 3.0, (n, 2)), axis=0)
    rig = motion.turn_mm + knocks, motion.slide_mm + 0.3 * knocks
    return Motion(motion.time_s, *rig, motion.bridge_mm, motion.sigma_mm, motion.noise_mm)


BRIDGES: tuple[Simulate, ...] = (
    quiet,
    vibrating,
    traffic,
    opposed_warmth,
    gusts,
    sunny_rig,
    nights,
    hourly,
    touched,
)
