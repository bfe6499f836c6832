"""Two sides of a possible jump: as many rows before as after it, held against earlier ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from core.arrays import FloatArray
from core.quality.opposed_steps import (
    BLOCK_ROWS,
    BLOCK_TAIL_POWER,
    TAIL_POWER,
    OpposedSteps,
    block_medians,
    chance_of,
    chance_of_both,
    pairs_apart,
)
from core.quality.row_series import Quantity, RowSeries

NOISE_SIGMAS = 4.5
"""Of the sum of two rows' sigmas: smaller steps between them are noise. Of two equal rows it is 6.4
standard deviations of their difference, by chance one row in a billion."""
_MEDIAN_SIGMA = 1.2533 / BLOCK_ROWS**0.5
"""Sigma of the median of a block over that of a row, noise being normal."""
_GAP_INTERVALS = 3.0
"""Rows further apart than so many usual intervals have a gap between them: no block holds one."""
_SHARP = 0.5
"""Share of a block's step that must lie between the two rows where the blocks meet: a slip is
sudden, the sun is not. Half, as the sum of two opposed steps may be."""

Channel = Literal["false_mm", "slide_mm"]
Witness = Literal["mm", "closure_mm"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)


@dataclass(frozen=True, slots=True)
class Junction:
    """Where rows may have jumped."""

    before: RowSeries
    after: RowSeries
    """As many: one row each, or a block."""
    step: RowSeries
    """One row: between the medians of both sides, in each quantity."""

    @classmethod
    def of(cls, recent: RowSeries, row: RowSeries, count: int) -> Junction | None:
        """Hold the last `count` rows, `row` the last of them, against as many before.

        None where there are not so many, or where a block has a gap.
        """
        if len(recent) < 2 * count - 1:
            return None
        if count == 1:
            return cls.between(recent[-1:], row)
        rows = recent[len(recent) - 2 * count + 1 :].followed_by(row)
        if _gaps(rows.time_s, interval_s(recent.time_s)).any():
            return None
        return cls.between(rows[:count], rows[count:])

    @classmethod
    def between(cls, before: RowSeries, after: RowSeries) -> Junction:
        """Hold rows against as many others."""
        count = len(after)
        middles = [block_medians(side.table, count) for side in (before, after)]
        return cls(before, after, RowSeries(middles[1] - middles[0]))

    @property
    def count(self) -> int:
        """Rows on either side."""
        return len(self.after)

    @property
    def power(self) -> float:
        """Of the tail of such steps."""
        return TAIL_POWER if self.count == 1 else BLOCK_TAIL_POWER

    @property
    def elapsed_s(self) -> float:
        """From the middle of one side to that of the other."""
        middle = self.count // 2
        return float(self.after.time_s[middle] - self.before.time_s[middle])

    @property
    def witness(self) -> Witness:
        """A plate at rest, where all rows show one; else the bridge."""
        sides = (self.before, self.after)
        seen = all(np.isfinite(side.values_mm("closure_mm")).all() for side in sides)
        return "closure_mm" if seen else "mm"

    def step_mm(self, name: Quantity) -> FloatArray:
        """(2,) between the medians of both sides."""
        step_mm: FloatArray = self.step.values_mm(name)[0]
        return step_mm

    def sigma_mm(self, name: Quantity) -> tuple[float, float]:
        """1 sigma of either side; one that is not known is taken to be as the other."""
        share = 1.0 if self.count == 1 else _MEDIAN_SIGMA
        before, after = (
            share * float(np.fmax.reduce(side.sigma_mm(name))) for side in (self.before, self.after)
        )
        return (after if np.isnan(before) else before), (before if np.isnan(after) else after)

    def noise_mm(self, name: Quantity) -> float:
        """Steps up to this size are noise."""
        return NOISE_SIGMAS * sum(self.sigma_mm(name))

    def chance_of_jump(self, earlier: RowSeries, channel: Channel, axis: int) -> float:
        """Bound the chance that steps along an axis are opposed like this after earlier rows.

        1 where they do not look like a slip at all.
        """
        witness = self.witness
        channel_mm, witness_mm = (float(self.step_mm(name)[axis]) for name in (channel, witness))
        noise_mm = math.hypot(*self.sigma_mm(channel)), math.hypot(*self.sigma_mm(witness))
        steps = OpposedSteps(channel_mm, witness_mm, noise_mm)
        if not steps.cancel or not self._is_sharp(steps, channel, axis):
            return 1.0
        if steps.size < max(self.noise_mm(channel), self.noise_mm(witness)):
            return 1.0
        times_s, channel_values = earlier_values(earlier, channel, axis, self.count)
        _, witness_values = earlier_values(earlier, witness, axis, self.count)
        pairs = pairs_apart(times_s, self.elapsed_s, self.count)
        if pairs is None:
            return 1.0
        at_rest = witness == "closure_mm"
        return chance_of_both(
            steps, channel_values, witness_values, pairs, self.power, at_rest=at_rest
        )

    def usual_mm(self, earlier: RowSeries, name: Quantity, axis: int) -> float:
        """The largest step of earlier rows over as long a time, or noise if that is more."""
        times_s, values = earlier_values(earlier, name, axis, self.count)
        pairs = pairs_apart(times_s, self.elapsed_s, self.count)
        if pairs is None:
            return self.noise_mm(name)
        steps_mm = pairs.stretch * np.abs(values[pairs.second] - values[pairs.first])
        return max(float(np.fmax.reduce(steps_mm)), self.noise_mm(name))

    def chance(self, size_mm: float, earlier: RowSeries, name: Witness, axis: int) -> float:
        """Bound the chance that such a step has this size by what earlier rows did."""
        times_s, values = earlier_values(earlier, name, axis, self.count)
        pairs = pairs_apart(times_s, self.elapsed_s, self.count)
        if pairs is None:
            return 1.0
        before_mm = pairs.stretch * np.abs(values[pairs.second] - values[pairs.first])
        return chance_of(size_mm, before_mm, pairs.count, self.noise_mm(name), self.power)

    def _is_sharp(self, steps: OpposedSteps, channel: Channel, axis: int) -> bool:
        """Whether the two rows where both sides meet show the step already."""
        for name, sign in ((channel, 1.0), (self.witness, -1.0)):
            here = self.after.values_mm(name)[0, axis] - self.before.values_mm(name)[-1, axis]
            if sign * math.copysign(here, here * steps.channel) < _SHARP * steps.size:
                return False
        return True


def earlier_values(
    earlier: RowSeries, name: Quantity, axis: int, count: int
) -> tuple[FloatArray, FloatArray]:
    """Times and values (n,) of earlier rows, or of their blocks without a gap."""
    times_s, values = earlier.time_s, earlier.values_mm(name)[:, axis]
    if count == 1:
        return times_s, values
    if len(times_s) < count:
        return np.zeros(0), np.zeros(0)
    gaps = np.concatenate([[0], np.cumsum(_gaps(times_s, interval_s(times_s)))])
    whole = gaps[count - 1 :] == gaps[: len(gaps) - count + 1]
    middle = count // 2
    return times_s[middle : len(times_s) - middle][whole], block_medians(values, count)[whole]


def interval_s(times_s: FloatArray) -> float:
    """The usual time from one row to the next; 0 of a single one."""
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0


def _gaps(times_s: FloatArray, usual_s: float) -> NDArray[np.bool_]:
    """Where two rows have a gap between them."""
    return np.asarray(np.diff(times_s) > _GAP_INTERVALS * usual_s)
