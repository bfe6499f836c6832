"""Measurements as CSV: the columns of `reprocess` first, then everything else a row knows."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from itertools import islice
from typing import Any, TextIO

import numpy as np

from core.results import Measurement
from daemon.reports.slot_table import SlotTable, kind_of_column
from daemon.store.queries.columns import BATCH
from daemon.store.queries.sensors import is_reading
from daemon.store.rows.convert import (
    BURST_COLUMNS,
    RESULT_COLUMNS,
    STABILITY_COLUMNS,
    result_columns,
)
from daemon.store.rows.targets import TARGET_RESULT_COLUMNS, columns_of_target, target_values
from daemon.times import slot_text

DECIMALS = {
    "mm": 6,
    "mm2": 12,
    "rad": 9,
    "px": 6,
    "dn": 3,
    "s": 6,
    "us": 3,
    "db": 4,
    "c": 4,
}
"""Of numbers, by the unit that their names end in: a thousandth of what noise hides, or less."""

_TRUTHS = {None: "", 0: "false", 1: "true"}


def write_results(
    results: Iterable[tuple[datetime, Measurement]],
    output: TextIO,
    *,
    targets: Sequence[str] = (),
    bursts: bool = False,
) -> int:
    """Write slots and what was measured in them; give the number of rows.

    `targets` are the names of the further targets that get columns; `bursts` appends those of
    slots with several pairs.
    """
    names = [*RESULT_COLUMNS, *STABILITY_COLUMNS]
    for name in targets:
        names += columns_of_target(name, TARGET_RESULT_COLUMNS)
    names += BURST_COLUMNS if bursts else ()
    rows = (_result_row(slot_utc, measurement) for slot_utc, measurement in results)
    table = _Table(output, names)
    while batch := list(islice(rows, BATCH)):
        table.write({name: [row.get(name) for row in batch] for name in names})
    return table.rows


def _result_row(slot_utc: datetime, measurement: Measurement) -> dict[str, Any]:
    row = result_columns(slot_utc, measurement) | {"slot_utc": slot_text(slot_utc)}
    for target in measurement.targets:
        values = target_values(target)
        keys = [key for key in TARGET_RESULT_COLUMNS if key in values]
        names = columns_of_target(target.name, keys)
        row |= zip(names, (values[key] for key in keys), strict=True)
    return row


def write_slots(slots: SlotTable, output: TextIO) -> int:
    """Write every slot of a table with all its columns; give the number of rows.

    Numbers have the digits that `DECIMALS` says; what a slot does not have is empty.
    """
    table = _Table(output, slots.columns)
    for batch in slots.batches:
        table.write(batch.values)
    return table.rows


class _Table:
    """A CSV file that grows by many rows at a time."""

    def __init__(self, output: TextIO, names: Sequence[str]) -> None:
        self._names, self._lines = names, csv.writer(output, lineterminator="\n")
        self._lines.writerow(names)
        self.rows = 0

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        cells = [_cells(name, columns[name]) for name in self._names]
        self._lines.writerows(zip(*cells, strict=True))
        self.rows += len(cells[0])


def _cells(name: str, values: Sequence[Any]) -> Sequence[str]:
    kind = kind_of_column(name)
    if is_reading(name):  # as they were stored: their units are the site's
        return ["" if value is None else repr(value) for value in values]
    if kind == "real":
        return _real_cells(values, DECIMALS[name.rpartition("_")[2]])
    if kind == "truth":
        return [_TRUTHS[value] for value in values]
    return ["" if value is None else str(value) for value in values]


def _real_cells(values: Sequence[float | None], decimals: int) -> list[str]:
    numbers = np.round(np.array(values, dtype=np.float64), decimals) + 0.0  # no -0.0
    pairs = zip(values, numbers.tolist(), strict=True)
    return ["" if value is None else repr(number) for value, number in pairs]
