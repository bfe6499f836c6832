"""What fixed targets taught of the rig, as of the midnight before each slot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np
import structlog

from core.arrays import FloatArray
from core.quality.fixed_targets import PastRow
from core.results import Reason
from core.rig.calibrated_site import CalibratedSite
from core.rig.learning import ALIKE
from core.rig.learnt import Learnt, learn
from daemon.slots.measuring import ActiveCalibration

_log = structlog.get_logger("dcam.daemon")

_WINDOW = timedelta(days=90)
"""Rows that are learnt from. Chosen: a season, and read in a second."""
_HOUR_S = 3600.0

State = tuple[int, int]
"""Changes with the rows before a slot, see `Store.state_before`."""
Hours = Callable[[datetime, datetime], FloatArray]
"""Gives (n, 4) hours since <= slot < until: middle (s since 1970), temperature (C), x, y (mm)."""


@dataclass(slots=True)
class Learner:
    """Learns once a day, from the rows of the 90 days before: the same rows, the same numbers."""

    _of: tuple[int | None, datetime, State] | None = None
    _learnt: Learnt | None = None

    def at(
        self,
        slot_utc: datetime,
        calibration: ActiveCalibration,
        hours: Hours,
        state: Callable[[datetime], State] = lambda _until: (0, 0),
    ) -> Learnt | None:
        """Give what the days before a slot taught; None where that is too little.

        state tells whether the rows before a time are those of the last call.
        """
        distance_mm = watched_distance_mm(calibration.calibration.calibrated)
        if distance_mm is None:
            return None
        midnight_utc = slot_utc.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
        of = (calibration.id, midnight_utc, state(midnight_utc))
        if of != self._of:
            known = hours(midnight_utc - _WINDOW, midnight_utc)
            self._of, self._learnt = of, _learnt(known, distance_mm)
        return self._learnt


@dataclass(slots=True)
class ComputedClosures:
    """Closures of rows that were just computed, by the hour."""

    _rows: list[tuple[float, float, float, float]] = field(default_factory=list)

    def add(self, row: PastRow) -> None:
        """Keep a row's closure, if the budget explains it and the temperature is known."""
        closure, celsius = row.measurement.closure, row.moment.temperature_c
        if closure is None or celsius is None:
            return
        if Reason.CLOSURE_TOO_LARGE not in row.measurement.reasons:
            x_mm, y_mm = map(float, closure.mm)
            self._rows.append((row.moment.utc_s, celsius, x_mm, y_mm))

    def hours(self, since: datetime, until: datetime) -> FloatArray:
        """As `Hours`."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 4)
        rows = rows[(rows[:, 0] >= since.timestamp()) & (rows[:, 0] < until.timestamp())]
        starts, which = np.unique(rows[:, 0] // _HOUR_S, return_inverse=True)
        means = [
            np.bincount(which, rows[:, column], len(starts)) / np.bincount(which)
            for column in (1, 2, 3)
        ]
        return np.column_stack([(starts + 0.5) * _HOUR_S, *means])


def watched_distance_mm(calibrated: CalibratedSite) -> float | None:
    """The distance of the fixed targets; None without any, or where it is not one distance."""
    known = [target.distance_mm for target in calibrated.further if target.is_fixed]
    if not known or max(known) > ALIKE * min(known):
        return None
    return sum(known) / len(known)


def _learnt(hours: FloatArray, distance_mm: float) -> Learnt | None:
    try:
        return learn(hours[:, 0], hours[:, 1], 1e6 * hours[:, 2:] / distance_mm)
    except np.linalg.LinAlgError:
        _log.exception("learning_broke")
        return None
