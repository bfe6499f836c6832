"""Rows made once more from their kept frames, by the line that made them, and compared."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from core.site import Site
from daemon.slots.identity import made_by
from daemon.slots.learner import Learner
from daemon.slots.measuring import ActiveCalibration, load_pairs
from daemon.slots.measuring_again import calibration_of, change_mm
from daemon.slots.row_history import measure_in_record
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import Again, MeasurementRecord
from daemon.store.rows.convert import measurement_columns
from daemon.store.verification import Finding, Tell
from daemon.times import EPOCH, slot_text

WAITS = "waits"
SETTLED = (Again.MEASURED, Again.MOVED)


@dataclass(slots=True)
class Compared:
    """Rows of which a difference is counted, and is no finding."""

    rows: int = 0
    differing: int = 0
    flags: int = 0
    """Of these, with another flag or other reasons."""
    largest_mm: float = 0.0
    """The largest difference of a corrected value."""

    def add(self, stored: MeasurementRecord, made: MeasurementRecord) -> None:
        """Count a row."""
        self.rows += 1
        if not _differing(stored, made):
            return
        self.differing += 1
        before, now = stored.measurement, made.measurement
        if (before.flag, before.reasons) != (now.flag, now.reasons):
            self.flags += 1
        self.largest_mm = max(self.largest_mm, change_mm(stored, made))


@dataclass(slots=True)
class Rebuilt:
    """How many rows were made once more, and how many could not be."""

    rows: int = 0
    """Made by these numerics (`made_by`): compared to the last bit."""
    other: Compared = field(default_factory=Compared)
    """Made by other numerics."""
    redated: Compared = field(default_factory=Compared)
    """Measured as of the time of a wrong clock, and not again since; now as of the true one."""
    beside: Compared = field(default_factory=Compared)
    """Held against rows that stood in wrong slots, and went elsewhere since."""
    not_again: dict[str, int] = field(default_factory=dict)
    """All rows of a wrong clock that were not measured again, by why: `Again`, or WAITS."""
    skipped: int = 0
    """Of another config, without frames, or of a calibration that cannot be read."""

    @property
    def all_rows(self) -> int:
        """How many were made once more."""
        return self.rows + self.other.rows + self.redated.rows + self.beside.rows


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

        A row of the same numerics, config, calibration and frames must be the same to the last
        bit, among the rows that were there when it was measured. One of other numerics is counted
        with its difference, and one whose values, or those of the rows that it was held against,
        are as of a wrong clock's time.
        """
        redated = self.store.redated()
        misled = [entry.seen_by for entry in redated]
        why = [entry.again or WAITS for entry in redated if entry.again not in SETTLED]
        counted.not_again = dict(Counter(map(str, why)))
        slots = self.archive.stored_slots(since or EPOCH)
        random.SystemRandom().shuffle(slots)
        learner = Learner()
        for slot_utc in slots:
            if counted.all_rows >= wanted:
                return
            record, row_id = self.store.measurement(slot_utc), self.store.row_id(slot_utc)
            calibration = None if record is None else self._calibration(record)
            if record is None or row_id is None or calibration is None:
                counted.skipped += 1
                continue
            again = self._again(record, row_id, calibration, learner)
            if record.version != made_by():
                counted.other.add(record, again)
            elif record.redated_from_utc is not None and not record.recorded_late:
                counted.redated.add(record, again)
            elif any(row_id in seen_by for seen_by in misled):
                counted.beside.add(record, again)
            else:
                counted.rows += 1
                yield from _differences(record, again)
            tell(counted.all_rows, min(wanted, len(slots)))

    def _calibration(self, record: MeasurementRecord) -> ActiveCalibration | None:
        """What the row was measured with, if it can be measured so once more."""
        if record.config_hash != self.config_hash:
            return None
        return None if record.main_frame is None else calibration_of(self.store, record)

    def _again(
        self,
        record: MeasurementRecord,
        row_id: int,
        calibration: ActiveCalibration,
        learner: Learner,
    ) -> MeasurementRecord:
        pairs, _ = load_pairs(self.archive, record.slot_utc)
        measurement = measure_in_record(
            *(self.store.as_before(row_id), self.site, calibration, learner),
            *(record.slot_utc, pairs),
        )
        return replace(record, measurement=measurement)


def _differences(record: MeasurementRecord, again: MeasurementRecord) -> Iterator[Finding]:
    differing = _differing(record, again)
    if differing:
        name = "y_mm" if "y_mm" in differing else next(iter(differing))
        stored, made = differing[name]
        text = (
            f"made from its frames once more it differs in {', '.join(differing)}: "
            f"{name} {stored} was stored, {made} comes out"
        )
        todo = "code, libraries and type of processor are those that measured it: please report it"
        yield Finding("row", slot_text(record.slot_utc), text, todo)


def _differing(record: MeasurementRecord, again: MeasurementRecord) -> dict[str, tuple[Any, Any]]:
    """The columns that differ: as stored, and as they come out."""
    stored, made = (measurement_columns(one) for one in (record, again))
    names = dict.fromkeys((*stored, *made))
    both = {name: (stored.get(name), made.get(name)) for name in names}
    return {name: pair for name, pair in both.items() if pair[0] != pair[1]}
