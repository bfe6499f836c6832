"""What hangs on the rows before: done in one process, in the order of the slots."""

from __future__ import annotations

from collections import deque

from core.quality.fixed_targets import HISTORY_ROWS, PastRow
from core.results import Measurement
from core.site import Site
from daemon.reprocessing.frames import SeenSlot
from daemon.slots.learner import ComputedClosures, Learner
from daemon.slots.measuring import ActiveCalibration, judge
from daemon.slots.row_history import RowHistory
from daemon.store.rows.datum import in_record_zero


class InOrder:
    """Measures slot after slot, each with what the rows before say of it."""

    def __init__(self, site: Site, calibration: ActiveCalibration) -> None:
        self._site, self._calibration = site, calibration
        self._sequence = RowHistory(calibration, site.quality)
        self._past: deque[PastRow] = deque(maxlen=HISTORY_ROWS)
        self._learner, self._closures = Learner(), ComputedClosures()

    def measurement(self, seen: SeenSlot) -> Measurement:
        """The next slot's measurement, in the record's zero."""
        learnt = self._learner.at(seen.slot_utc, self._calibration, self._closures.hours)
        alone = judge(seen.pairs, self._site, self._calibration, self._past, learnt)
        measurement = self._sequence.judge(seen.slot_utc, alone)
        self._past.append(PastRow(seen.moment, measurement))
        self._closures.add(self._past[-1])
        return in_record_zero(measurement, self._calibration.datum)
