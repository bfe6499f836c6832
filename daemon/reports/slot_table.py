"""The table that `export` writes: every slot once, measured or in a gap, many at a time."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from heapq import merge
from typing import Any

from core.results import Flag
from daemon.store.database import Store
from daemon.store.integrity.checksum import DIGEST
from daemon.store.ledger.entries import LedgerEntry, excluded_points, read_ledger
from daemon.store.queries.columns import BATCH, Columns, Tell, read_columns, target_roles
from daemon.store.queries.sensors import CAUSES, Sensor, is_reading, sensor_columns, sensors_within
from daemon.store.records import GapRecord
from daemon.store.rows.convert import RESULT_COLUMNS
from daemon.store.rows.targets import (
    TARGET_COLUMNS,
    columns_of_target,
    target_of_column,
    values_of_targets,
)
from daemon.store.runs import next_second, run_between, slot_at, unix_s
from daemon.store.schema import Kind, MeasurementRow, kind_of
from daemon.times import slot_text

EXCLUDED = "excluded"
"""The points whose values of a slot the quality ledger leaves out."""
DETAIL = "detail"
"""The last column: what is known of a gap beyond its cause."""

TARGETS = "targets"
"""The column of the database that becomes columns of each further target."""
READINGS = "readings"
"""The column of the database that becomes a column of each sensor."""

EXTRA_COLUMNS = tuple(
    column.name
    for column in MeasurementRow.__table__.columns
    if column.name not in {"id", DIGEST, TARGETS, READINGS, *RESULT_COLUMNS}
)
"""What `export` adds to the columns of `reprocess`, in the order of the database."""

COLUMNS = (*RESULT_COLUMNS, *EXTRA_COLUMNS, EXCLUDED, DETAIL)
"""Of a site without further targets and sensors; theirs come before the last two."""

Missed = tuple[str, str, str]
"""A slot in a gap: slot, cause, detail."""


@dataclass(frozen=True, slots=True)
class SlotTable:
    """A table of slots, read as it is written."""

    columns: tuple[str, ...]
    batches: Iterator[Columns]
    """Many slots at a time, each with all columns."""
    sensors: tuple[Sensor, ...] = ()
    roles: Mapping[str, str] = field(default_factory=dict)
    """Of each further target by its name: fixed or measured."""


def slot_table(store: Store, since: datetime, until: datetime, tell: Tell) -> SlotTable:
    """Slots with since <= slot < until, in order: rows, and those in gaps with flag 9.

    Of a slot in a gap the reasons are the gap's cause. Further targets and sensors have the names
    that the rows give them. Raises StoreError; DatabaseDamagedError, at the latest as the batches
    are read, names the first row that is not what was written.
    """
    roles = target_roles(store.path, since, until)
    targets = list(roles)
    columns = (column for name in targets for column in columns_of_target(name, TARGET_COLUMNS))
    sensors = sensors_within(store.path, since, until)
    said = (*(sensor.column for sensor in sensors), CAUSES) if sensors else ()
    batches = _judged(
        _batches(store, since, until, tell, targets, sensors), read_ledger(store.path)
    )
    return SlotTable((*COLUMNS[:-2], *columns, *said, EXCLUDED, DETAIL), batches, sensors, roles)


def _batches(
    store: Store,
    since: datetime,
    until: datetime,
    tell: Tell,
    targets: Sequence[str],
    sensors: Sequence[Sensor],
) -> Iterator[Columns]:
    limits = range(*(unix_s(next_second(time)) for time in (since, until)))
    missed = _MissedSlots(store.gaps(since, until), limits)
    for rows in read_columns(store.path, since, until, tell):
        slots, begin = rows.values["slot_utc"], 0
        while begin < len(slots):
            taken = missed.until(slots[-1])
            # As many as may stand in memory together: more may come before the next row.
            end = bisect_left(slots, taken[-1][0]) if len(taken) == BATCH else len(slots)
            yield _joined(rows, slice(begin, end), taken, targets, sensors)
            begin = end
    while taken := missed.until("~"):
        yield _joined(Columns({"slot_utc": ()}), slice(0), taken, targets, sensors)


def _judged(batches: Iterator[Columns], entries: Sequence[LedgerEntry]) -> Iterator[Columns]:
    """Tables with what the quality ledger leaves out of each slot."""
    for batch in batches:
        excluded = excluded_points(batch.values["slot_utc"], entries)
        yield Columns({**batch.values, EXCLUDED: excluded})


def kind_of_column(name: str) -> Kind:
    """What a column of the table holds."""
    if is_reading(name):
        return "real"
    target = None if name in COLUMNS else target_of_column(name)
    key = name if target is None else target[1]
    return "text" if key in {CAUSES, EXCLUDED, DETAIL, "role"} else kind_of(key)


class _MissedSlots:
    """The slots of gaps, in order, a part at a time."""

    def __init__(self, gaps: Sequence[GapRecord], limits: range) -> None:
        self._slots = merge(*(_slots_of(gap, limits) for gap in gaps))
        self._next = next(self._slots, None)

    def until(self, last: str) -> list[Missed]:
        """The next slots up to one, this included, but no more than a batch."""
        taken: list[Missed] = []
        while self._next is not None and self._next[0] <= last and len(taken) < BATCH:
            taken.append(self._next)
            self._next = next(self._slots, None)
        return taken


def _slots_of(gap: GapRecord, limits: range) -> Iterator[Missed]:
    for unix in run_between(gap.first_slot_utc, gap.last_slot_utc, gap.period_s):
        if unix in limits:
            yield slot_text(slot_at(unix)), gap.cause.value, gap.detail


def _joined(
    rows: Columns,
    part: slice,
    missed: Sequence[Missed],
    targets: Sequence[str],
    sensors: Sequence[Sensor],
) -> Columns:
    """Rows and missed slots as one table in order; where both claim a slot, the row counts."""
    slots = rows.values["slot_utc"][part]
    if missed:
        measured = set(slots)
        missed = [one for one in missed if one[0] not in measured]
    of_gaps: dict[str, Sequence[Any]] = dict(
        zip(("slot_utc", "reasons", DETAIL), zip(*missed, strict=True), strict=False)
    )
    of_gaps["flag"] = [int(Flag.MISSING)] * len(missed)
    none = [None] * len(missed)
    every = [*slots, *of_gaps.get("slot_utc", ())]
    order = sorted(range(len(every)), key=every.__getitem__) if missed else None
    measured_columns = {name: rows.values[name][part] for name in COLUMNS if name in rows.values}
    measured_columns |= values_of_targets(rows.values.get(TARGETS, ())[part], targets)
    if sensors:
        measured_columns |= sensor_columns(rows.values.get(READINGS, ())[part], sensors)
    table: dict[str, Sequence[Any]] = {}
    for name in dict.fromkeys((*COLUMNS, *measured_columns)):
        measured_values = measured_columns.get(name, [None] * len(slots))
        values = [*measured_values, *of_gaps.get(name, none)]
        table[name] = values if order is None else [values[place] for place in order]
    return Columns(table)
