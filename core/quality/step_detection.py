"""What one row alone cannot show: whether the board has slipped or the main camera was knocked.

Main and sub-camera are one rigid body. When the rig moves, both see it. A board that slips on the
pier looks to the sub-camera like a motion of the rig, but the main image does not move with it, so
that the corrected displacement jumps by just what the rig is said to have moved by:

    step of the false displacement + step of the displacement = step of the raw one, about 0.

`opposed_steps` says when that is no chance. Each row is held against the one before, and the median
of a block of rows against that of the block before: a slip stays, a train passes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from core.arrays import FloatArray
from core.quality.junction import CHANNELS, Channel, Junction, interval_s
from core.quality.opposed_steps import BLOCK_ROWS, SLIP_CHANCE
from core.quality.residual_ratio import WINDOW_ROWS, median_residual_ratio
from core.quality.row_series import RowSeries, RowSummary
from core.quality.verdicts import flag_of
from core.results import Measurement, Reason
from core.site import QualityLimits

USUAL_ROWS = 1440
"""Rows that say which steps are usual: a day of minutes."""
_LEAST_ROWS = 3
"""Two steps: before them nothing is known of what is usual."""
SETTLED_ROWS = 120
"""Rows after which a slip stands: until then the bridge may show that it was none. Chosen: two
hours of minutes; later the bridge's own way is longer than most slips."""
_WITHDRAWN = 0.25
"""Share of a slip that the displacement's step may still hold where there was none."""
_WRONGLY_WITHDRAWN = 1e-3
"""Chance that a true slip is taken back because the bridge moved just so, over all SETTLED_ROWS."""
_DRIFT_FACTOR = 2.0
"""Residuals so many times what they were at calibration, for so long, say that lens, board or focus
have changed. Chosen between noise of a few per cent and values that are visibly wrong."""

_NO_ROWS = RowSeries.of()


@dataclass(frozen=True, slots=True)
class Jump:
    """Steps that look more or less like a slip, and what that is worth."""

    chance: float
    """Bound of the chance that rig and bridge did it; 1 where it does not look like a slip."""
    junction: Junction
    earlier: RowSeries
    """The rows that say what is usual."""
    channel: Channel
    axis: int
    """0 for x, 1 for y."""


@dataclass(frozen=True, slots=True)
class BoardSlip:
    """A slip that is not undone."""

    channel: Channel
    axis: int
    """0 for x, 1 for y: along which it was found."""
    by_mm: FloatArray
    """(2,) by how much the rig is wrongly said to have moved."""
    since_s: float
    """Time of the first row after it; rows from then to the first marked one are displaced, too."""
    level: RowSeries
    """The last rows before it, at most a block."""
    rows: RowSeries = _NO_ROWS
    """The rows that are marked for it, at most the last SETTLED_ROWS + 1."""


@dataclass(frozen=True, slots=True)
class StepDetector:
    """The rows of one calibration so far, and what they say of the next (immutable)."""

    history: RowSeries = _NO_ROWS
    """The last rows that are believed, in order."""
    slip: BoardSlip | None = None

    @classmethod
    def resumed(cls, history: RowSeries, slipped: RowSeries) -> StepDetector:
        """Continue from stored rows: those believed, and those of a slip since.

        Of a slip that is older than SETTLED_ROWS the first row and the last SETTLED_ROWS.
        """
        state = cls(history[-USUAL_ROWS:])
        if not len(slipped) or not len(state.history):
            return state
        first = slipped[:1]
        slip = state._slip(first)
        if slip is None:  # marked by another version
            junction = Junction.between(state.history[-1:], first)
            slip = _slip_of(junction, state.history, "false_mm", 1)
        return replace(state, slip=replace(slip, rows=slipped[-SETTLED_ROWS - 1 :]))

    def judge(
        self, now: RowSummary, limits: QualityLimits
    ) -> tuple[tuple[Reason, ...], StepDetector]:
        """Give what the rows before make of a row, and the state after it.

        A row that is not good in itself is neither judged nor remembered.
        """
        if not now.trusted:
            return (), self
        row = RowSeries.of(now)
        slip = self.slip or self._slip(row)
        if slip is not None and not (self.slip and self._has_ended(slip, row)):
            rows = slip.rows.followed_by(row)[-SETTLED_ROWS - 1 :]
            return (Reason.BOARD_SLIPPED,), replace(self, slip=replace(slip, rows=rows))
        if self._too_fast(now, limits.max_step_mm):
            return (Reason.CAMERA_BUMPED,), replace(self, slip=None)
        after = StepDetector(self.history.followed_by(row)[-USUAL_ROWS:])
        return ((Reason.CALIBRATION_DRIFTING,) if after.is_drifting else ()), after

    @property
    def residual_ratio(self) -> float | None:
        """The median residual of the last rows; None if they are too few."""
        return median_residual_ratio(self.history.residual_ratio[-WINDOW_ROWS:].tolist())

    @property
    def is_drifting(self) -> bool:
        """Whether the corners fit so badly for so long that values are doubtful."""
        return self.residual_ratio is not None and self.residual_ratio > _DRIFT_FACTOR

    def _slip(self, row: RowSeries) -> BoardSlip | None:
        """Find a slip in the last rows."""
        jump = unlikeliest_jump(self.history, row)
        if jump is None or jump.chance > SLIP_CHANCE:
            return None
        return _slip_of(jump.junction, jump.earlier, jump.channel, jump.axis)

    def _has_ended(self, slip: BoardSlip, row: RowSeries) -> bool:
        """Whether the board is back where it was, or has never been away."""
        if self._is_withdrawn(slip, slip.rows.followed_by(row)):
            return True
        junctions = (Junction.of(slip.rows, row, count) for count in (1, BLOCK_ROWS))
        return any(self._is_undone(slip, junction) for junction in junctions if junction)

    def _is_undone(self, slip: BoardSlip, junction: Junction) -> bool:
        """Whether a jump that is as unlikely by chance as a slip takes the slip back, wholly."""
        if junction.chance_of_jump(self.history, slip.channel, slip.axis) > SLIP_CHANCE:
            return False
        names = slip.channel, junction.witness
        left_mm = junction.step_mm(names[0]) + slip.by_mm, junction.step_mm(names[1]) - slip.by_mm
        usual_mm = [junction.usual_mm(self.history, name, slip.axis) for name in names]
        # What the slip was is known as well as the steadier of the two shows it.
        return all(
            abs(left[slip.axis]) <= usual + min(usual_mm)
            for left, usual in zip(left_mm, usual_mm, strict=True)
        )

    def _is_withdrawn(self, slip: BoardSlip, rows: RowSeries) -> bool:
        """Whether the displacement is back at its level before, as by chance it would not be.

        Then it was the rig that moved, and the bridge that undid it for a while.
        """
        if len(slip.level) < BLOCK_ROWS or not BLOCK_ROWS <= len(rows) <= SETTLED_ROWS:
            return False
        junction = Junction.between(slip.level, rows[-BLOCK_ROWS:])
        moved_mm, by_mm = junction.step_mm("mm")[slip.axis], slip.by_mm[slip.axis]
        if abs(moved_mm) > _WITHDRAWN * abs(by_mm):
            return False
        earlier = self.history[: int(np.searchsorted(self.history.time_s, slip.since_s))]
        chance = junction.chance(abs(moved_mm + by_mm), earlier, "mm", slip.axis)
        return chance < _WRONGLY_WITHDRAWN / (SETTLED_ROWS - BLOCK_ROWS + 1)

    def _too_fast(self, now: RowSummary, max_step_mm: float | None) -> bool:
        if max_step_mm is None or not len(self.history):
            return False
        usual_s, elapsed_s = interval_s(self.history.time_s), now.time_s - self.history.time_s[-1]
        slots = max(1.0, elapsed_s / usual_s) if usual_s else 1.0
        return float(np.hypot(*(now.mm - self.history.values_mm("mm")[-1]))) > max_step_mm * slots


def unlikeliest_jump(recent: RowSeries, row: RowSeries) -> Jump | None:
    """Find the jump in the last rows that is least likely by chance; None after too few rows."""
    if len(recent) < _LEAST_ROWS:
        return None
    jumps = []
    for count in (1, BLOCK_ROWS):
        junction = Junction.of(recent, row, count)
        if junction is not None:
            earlier = recent[: len(recent) - count + 1]
            jumps += [
                Jump(junction.chance_of_jump(earlier, name, axis), junction, earlier, name, axis)
                for name in CHANNELS
                for axis in (0, 1)
            ]
    return min(jumps, key=lambda jump: jump.chance)


def _slip_of(junction: Junction, earlier: RowSeries, channel: Channel, axis: int) -> BoardSlip:
    """What the steadier of channel and witness says of a slip."""
    witness = junction.witness
    channel_mm, witness_mm = (junction.usual_mm(earlier, name, axis) for name in (channel, witness))
    by_channel = channel_mm < witness_mm
    by_mm = junction.step_mm(channel) if by_channel else -junction.step_mm(witness)
    since_s = float(junction.after.time_s[0])
    return BoardSlip(channel, axis, by_mm, since_s, earlier[-BLOCK_ROWS:])


def add_reasons(measurement: Measurement, reasons: tuple[Reason, ...]) -> Measurement:
    """Add the reasons that other rows give; the flag follows."""
    if not reasons:
        return measurement
    together = (*measurement.reasons, *reasons)
    flag = flag_of(together, has_value=measurement.corrected is not None)
    return replace(measurement, flag=flag, reasons=together)
