"""The test behind `board_slipped`, and the false-alarm rate that it keeps.

A board that slips by s adds s to the false displacement and takes s off the corrected one. Two
explanations of such a pair of opposed steps compete: the board slipped, or the rig moved and the
bridge undid it by chance. The second one is given up where its chance is below a false alarm in
`ROWS_A_FALSE_ALARM` rows. That chance follows from the rows before, without a distribution for
rig or bridge to be assumed:

*A step's chance.* Of n + 1 exchangeable steps each is the largest with the same probability. So a
step that exceeds the share r of n earlier ones has the chance (1 + (1 - r) n) / (n + 1), and one of
x times the largest has at most x^-k / (n + 1), as long as the tail falls at least with the
power k (Pareto's tail; generalised Pareto with shape 1 / k). Few rows know little: n is small. The
largest of them may be small by chance, P(M < m) ~ m^n, so that no bound falls faster than with n:
k is at most half of it.

*Independent.* Rig and bridge move independently, so the chance of both is that of a product of two
such chances p q. Neither is believed below `RAREST`. Then P(p q <= c) = c (1 + ln(c / RAREST^2))
for c < RAREST, and half of it, as the bridge must go the other way.

*Not independent.* Noise of the sub-camera's pose appears in both, opposed; so may wind. The opposed
part of two steps, min(|a|, |b|) where their signs differ and 0 else, is therefore held against the
opposed parts before, too. Being in the tails of both, it falls with twice the power.

*Weather.* In a storm the steps of a calm day say nothing, and rig and bridge are both shaken. So
each step is held against the others as it is, and again over the mean size of the
`RECENT_STEPS` before it, which they were measured in, too. The larger chance counts.

A plate that is known to be at rest takes the bridge's part where one is in view: then the
independent motion of the bridge needs no allowance, only what the plate has seemed to do so far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray

ROWS_A_FALSE_ALARM = 525_600
"""At most one false alarm in so many rows: in a year of a row a minute."""
TAIL_POWER = 3.0
"""With which the chance of a step falls beyond the largest one so far, at least. Student's t with
3 degrees of freedom has it; the heaviest whole power with a finite variance."""
BLOCK_ROWS = 9
"""Rows whose median is held against the median of as many before them: single trains and gusts are
gone from it. Odd, so that the median is one of them. Chosen: between early and sharp."""
BLOCK_TAIL_POWER = 2.0 * TAIL_POWER
"""Of medians: one far row does not move them, so that at least two must be far."""
RAREST = 1e-4
"""No step is believed rarer: in 10,000 rows, a week of minutes, somebody touches the rig, and
something heavier than before crosses the bridge."""
TESTS = 2 * 2 * 2
"""For each row: x and y, two channels, one row or a block."""
SLIP_CHANCE = 1.0 / ROWS_A_FALSE_ALARM / TESTS
"""Of a false alarm, for each test of each row (Bonferroni)."""
MATCH = 0.5
"""Share of the smaller of two opposed steps that their sum may leave. Both are a slip's plus
what rig or bridge did besides; steps beyond all usual ones differ by less."""
RECENT_STEPS = 30
"""Steps whose mean says how lively it is at a time: half an hour of minutes. Chosen: shorter than
weather, longer than chance."""
_BESIDE = 2.0
"""Pairs of earlier rows up to so many times further apart than those tested are compared with."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Earlier values so far apart in time as the two that are tested."""

    first: IntArray
    """(m,) indices."""
    second: IntArray
    """(m,)."""
    count: float
    """How many of them are independent."""
    overlap: int
    """Values so many on end share rows."""
    stretch: float = 1.0
    """What their steps are multiplied by: more than 1 where no two are so far apart."""


@dataclass(frozen=True, slots=True)
class OpposedSteps:
    """A step of a channel and the witness's (bridge or plate) along one axis, in one unit each."""

    channel: float
    witness: float
    noise: tuple[float, float]
    """1 sigma of either: so much is usual, whatever the rows before say."""

    @property
    def size(self) -> float:
        """The opposed part: 0 where they go the same way."""
        if self.channel * self.witness >= 0.0:
            return 0.0
        return min(abs(self.channel), abs(self.witness))

    @property
    def cancel(self) -> bool:
        """Whether they are opposed, and one undoes the other."""
        return abs(self.channel + self.witness) < MATCH * self.size

    def relative_to(self, channel: float, witness: float) -> OpposedSteps:
        """The same in other units."""
        noise = self.noise[0] / channel, self.noise[1] / witness
        return OpposedSteps(self.channel / channel, self.witness / witness, noise)


def pairs_apart(times_s: FloatArray, elapsed_s: float, overlap: int = 1) -> Pairs | None:
    """Find earlier values (n,) at least as far apart as given, each with the first such one.

    Where the values so far are too short a stretch, their ends, extrapolated: what goes on evenly
    goes so much further. `overlap` values on end share rows. None where they say nothing.
    """
    span_s = float(times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    if span_s <= 0.0:
        return None
    least_s = elapsed_s * (1.0 - 1e-3)
    second = np.searchsorted(times_s, times_s + least_s)
    first = np.flatnonzero(second < len(times_s))
    if not len(first):
        first, second = _far_pairs(len(times_s))
        return Pairs(first, second, 1.0, overlap, elapsed_s / span_s)
    second = second[first]
    beside = times_s[second] - times_s[first] <= _BESIDE * elapsed_s
    if beside.any():
        first, second = first[beside], second[beside]
    count = min(len(first) / overlap, span_s / elapsed_s)
    return Pairs(first, second, count, overlap)


def _far_pairs(n: int) -> tuple[IntArray, IntArray]:
    """All pairs of n values that are n - 1, half of it, a quarter ... of them apart."""
    lags = [lag for lag in ((n - 1) >> halvings for halvings in range(n.bit_length())) if lag]
    first = np.concatenate([np.arange(n - lag) for lag in lags])
    return first, np.concatenate([np.arange(lag, n) for lag in lags])


def chance_of(size: float, before: FloatArray, count: float, usual: float, power: float) -> float:
    """Bound the chance of a step of such a size after steps of these sizes (m,).

    `count` of them are independent; a step of `usual` is so whatever they say.
    """
    largest = max(float(before.max(initial=0.0)), usual)
    if size > largest:
        return float((largest / size) ** power) / (count + 1.0)
    share = float(np.mean(before >= size)) if len(before) else 1.0
    return (1.0 + share * count) / (count + 1.0)


def chance_of_both(
    steps: OpposedSteps,
    channel_mm: FloatArray,
    witness_mm: FloatArray,
    pairs: Pairs,
    power: float,
    *,
    at_rest: bool,
) -> float:
    """Bound the chance of opposed steps (mm) after earlier values (n,) of both.

    `at_rest` says that the witness is a plate, not a bridge. Values that are not known are nan.
    """
    apart = [values[pairs.second] - values[pairs.first] for values in (channel_mm, witness_mm)]
    known = np.isfinite(apart[0]) & np.isfinite(apart[1])
    channel, witness = (pairs.stretch * values[known] for values in apart)
    plain = _chance(steps, channel, witness, pairs.count, power, at_rest=at_rest)
    skipped = RECENT_STEPS + pairs.overlap - 1
    if pairs.stretch > 1.0 or len(channel) < 2 * skipped:
        return plain
    scales = [_recent_scale(before) for before in (channel, witness)]
    now = max(scales[0][-1], steps.noise[0]), max(scales[1][-1], steps.noise[1])
    channel, witness = (
        before[skipped:] / np.maximum(scale[: len(before) - skipped], noise)
        for before, scale, noise in zip((channel, witness), scales, steps.noise, strict=True)
    )
    count = pairs.count * len(channel) / (len(channel) + skipped)
    relative = steps.relative_to(*now)
    return max(plain, _chance(relative, channel, witness, count, power, at_rest=at_rest))


def _chance(
    steps: OpposedSteps,
    channel: FloatArray,
    witness: FloatArray,
    count: float,
    power: float,
    *,
    at_rest: bool,
) -> float:
    """Both ways together, after the steps (m,) of both so far."""
    opposed = np.minimum(np.abs(channel), np.abs(witness)) * (channel * witness < 0.0)
    power = min(power, count / 2.0)
    together = chance_of(steps.size, opposed, count, max(steps.noise), 2.0 * power)
    if at_rest:
        return together
    first = chance_of(abs(steps.channel), np.abs(channel), count, steps.noise[0], power)
    second = chance_of(abs(steps.witness), np.abs(witness), count, steps.noise[1], power)
    return max(together, chance_of_product(max(first, RAREST) * max(second, RAREST)))


def _recent_scale(steps: FloatArray) -> FloatArray:
    """Mean size (m - RECENT_STEPS + 1,) of runs of RECENT_STEPS of the steps (m,)."""
    sums = np.concatenate([[0.0], np.cumsum(np.abs(steps))])
    return np.asarray((sums[RECENT_STEPS:] - sums[:-RECENT_STEPS]) / RECENT_STEPS)


def chance_of_product(product: float) -> float:
    """Give the chance that two chances, neither below RAREST, have so small a product.

    Half of it, as the steps must be opposed too.

    >>> chance_of_product(1.0)
    0.5
    """
    return product * (1.0 + min(math.log(product / RAREST**2), -math.log(product))) / 2.0


def block_medians(values: FloatArray, count: int) -> FloatArray:
    """Medians (n - count + 1, ...) of all runs of an odd count of the values (n, ...)."""
    runs = np.lib.stride_tricks.sliding_window_view(values, count, axis=0)
    return np.asarray(np.partition(runs, count // 2, axis=-1)[..., count // 2])
