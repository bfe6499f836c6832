"""Rows made once more from their kept frames, by the line that made them, and compared."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from core.errors import CalibrationError
from core.site import Site
from daemon.slots.learner import Learner
from daemon.slots.measuring import ActiveCalibration, load_pairs
from daemon.slots.row_history import measure_in_record
from daemon.store.convert import measurement_columns
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import MeasurementRecord
from daemon.store.verification import Finding, Tell
from daemon.times import EPOCH, slot_text
from daemon.version import VERSION


@dataclass(slots=True)
class Rebuilt:
    """How many rows were made once more, and how many could not be."""

    rows: int = 0
    skipped: int = 0
    """Of another version or config, without frames, or of a calibration that cannot be read."""


@dataclass(frozen=True, slots=True)
class Rebuilding:
    """What rows are made once more with."""

    store: Store
    archive: FrameArchive
    site: Site
    config_hash: str

    def findings(
        self, wanted: int, since: datetime | None, counted: Rebuilt, tell: Tell
    ) -> Iterator[Finding]:
        """Rebuild some rows at random, and give those that come out otherwise. Raises StoreError.

        A row of the same version, config, calibration and frames must be the same to the last bit.
        """
        slots = self.archive.stored_slots(since or EPOCH)
        random.SystemRandom().shuffle(slots)
        learner = Learner()
        for slot_utc in slots:
            if counted.rows >= wanted:
                return
            record = self.store.measurement(slot_utc)
            calibration = None if record is None else self._calibration(record)
            if record is None or calibration is None:
                counted.skipped += 1
                continue
            again = self._again(record, calibration, learner)
            counted.rows += 1
            tell(counted.rows, min(wanted, len(slots)))
            yield from _differences(record, again)

    def _calibration(self, record: MeasurementRecord) -> ActiveCalibration | None:
        """What the row was measured with, if it can be measured so once more."""
        if (record.version, record.config_hash) != (VERSION, self.config_hash):
            return None
        if record.calibration_id is None or record.main_frame is None:
            return None
        found = self.store.calibration(record.calibration_id)
        try:
            return None if found is None else ActiveCalibration(found.id, found.calibration)
        except CalibrationError:
            return None

    def _again(
        self, record: MeasurementRecord, calibration: ActiveCalibration, learner: Learner
    ) -> MeasurementRecord:
        pairs, _ = load_pairs(self.archive, record.slot_utc)
        measurement = measure_in_record(
            self.store, self.site, calibration, learner, record.slot_utc, pairs
        )
        return replace(record, measurement=measurement)


def _differences(record: MeasurementRecord, again: MeasurementRecord) -> Iterator[Finding]:
    stored, made = (measurement_columns(one) for one in (record, again))
    names = [name for name in dict.fromkeys((*stored, *made)) if stored.get(name) != made.get(name)]
    if names:
        name = "y_mm" if "y_mm" in names else names[0]
        text = (
            f"made from its frames once more it differs in {', '.join(names)}: "
            f"{name} {stored.get(name)} was stored, {made.get(name)} comes out"
        )
        todo = "other libraries or another processor may round otherwise; else please report it"
        yield Finding("row", slot_text(record.slot_utc), text, todo)
