"""Rows that a wrong clock had dated are measured again as of their true times, between slots.

What is known of a row depends on how long ago its calibration was, and on the rows before it. So a
row that has got its slot (`time_correction`) is measured from its kept frames as that of any slot
is: among the rows that are in the record by now, the earliest first. Until then no other row is
held against it. The new row takes the old one's place in one transaction that keeps the old one.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import replace
from datetime import datetime

import numpy as np
import structlog

from core.errors import CalibrationError, digits
from core.results import Reason
from daemon.errors import StoreError
from daemon.slots.identity import made_by
from daemon.slots.learner import Learner
from daemon.slots.measuring import ActiveCalibration, load_pairs
from daemon.slots.pipeline import SlotContext, note_slip
from daemon.slots.row_history import measure_in_record
from daemon.store.database import Store
from daemon.store.records import Again, MeasurementRecord
from daemon.times import slot_text

_log = structlog.get_logger("dcam.daemon")

SHARE = 0.5
"""Of the time to the next slot: a row begins only if it is likely to end within that."""


class MeasuringAgain:
    """Measures what waits, one row after the other; for the daemon's own thread only."""

    def __init__(self, context: SlotContext, stop: threading.Event) -> None:
        self._context = context
        self._stop = stop
        self._learner = Learner()
        self._trouble: str | None = None
        """What kept the last row from being measured."""

    def tend(self, room_s: float, slot_s: float) -> None:
        """Measure as many as there is time for, if each takes as long as the last slot did."""
        clock, done = self._context.clock, Counter[Again]()
        begun_s = clock.monotonic_s()
        largest_mm, last_utc = 0.0, None
        try:
            while not self._stop.is_set():
                row_begun_s = clock.monotonic_s()
                if row_begun_s - begun_s + slot_s > SHARE * room_s:
                    break
                waiting = self._context.store.next_to_measure_again()
                if waiting is None:
                    break
                number, last_utc = waiting
                again, change_mm = self._measure(number, last_utc)
                done[again] += 1
                largest_mm = max(largest_mm, change_mm)
                slot_s = max(slot_s, clock.monotonic_s() - row_begun_s)
            if last_utc is not None:
                self._tell(last_utc, done, largest_mm)
        except StoreError as error:
            if self._trouble is None:
                _log.error("not_measured_again", error=str(error))
            self._trouble = str(error)
            return
        self._trouble = None

    def _measure(self, number: int, slot_utc: datetime) -> tuple[Again, float]:
        """Give what came of a row, and the largest change of a corrected value, mm."""
        store = self._context.store
        record = store.measurement(slot_utc)
        if record is None:
            return self._leave(number, Again.MOVED), 0.0
        found = self._measured(record)
        if isinstance(found, Again):
            return self._leave(number, found), 0.0
        try:
            store.measured_again(number, found)
        except ValueError:
            _log.exception("measuring_again_broke", slot=slot_text(slot_utc))
            return self._leave(number, Again.BROKE), 0.0
        note_slip(self._context, found, calibration_of(store, found))
        return Again.MEASURED, change_mm(record, found)

    def _leave(self, number: int, why: Again) -> Again:
        self._context.store.not_measured_again(number, why)
        return why

    def _measured(self, record: MeasurementRecord) -> MeasurementRecord | Again:
        """Give the row of the true time, or why there is none."""
        context = self._context
        calibration = calibration_of(context.store, record)
        if calibration is None:
            return Again.NO_CALIBRATION
        if record.main_frame is None or not context.archive.numbers(record.slot_utc):
            return Again.NO_FRAMES
        pairs, _ = load_pairs(context.archive, record.slot_utc)
        if any(pair.unreadable for pair in pairs):
            return Again.UNREADABLE
        try:
            measurement = measure_in_record(
                *(context.store, context.site, calibration, self._learner, record.slot_utc, pairs)
            )
        except StoreError:
            raise
        except Exception:  # noqa: BLE001 - one row must not keep the others, and the slots
            _log.exception("measuring_again_broke", slot=slot_text(record.slot_utc))
            return Again.BROKE
        if Reason.INTERNAL_ERROR in measurement.reasons:
            return Again.BROKE
        return replace(
            record,
            measurement=measurement,
            config_hash=context.config_hash,
            version=made_by(),
            recorded_late=True,
        )

    def _tell(self, last_utc: datetime, done: Counter[Again], largest_mm: float) -> None:
        """Enter in the history what was done."""
        left = ", ".join(
            f"{count} left as measured ({again.value})"
            for again, count in done.items()
            if again is not Again.MEASURED
        )
        detail = (
            f"as of their true times, up to slot {slot_text(last_utc)}: {done[Again.MEASURED]} rows"
            f", changed by {digits(largest_mm, 2)} mm at most{', ' if left else ''}{left}"
        )
        self._context.store.add_event(self._context.clock.now_utc(), "measured_again", detail)
        _log.info("measured_again", rows=done[Again.MEASURED], last=slot_text(last_utc))


def calibration_of(store: Store, record: MeasurementRecord) -> ActiveCalibration | None:
    """The calibration that a row was measured with, None if it cannot be read (any more)."""
    if record.calibration_id is None:
        return None
    found = store.calibration(record.calibration_id)
    try:
        return None if found is None else ActiveCalibration(found.id, found.calibration)
    except CalibrationError:
        return None


def change_mm(before: MeasurementRecord, now: MeasurementRecord) -> float:
    """The largest change of a corrected value; 0 where one of them has none."""
    was, is_now = before.measurement.corrected, now.measurement.corrected
    return 0.0 if was is None or is_now is None else float(np.abs(is_now.mm - was.mm).max())
