"""Measurements as CSV: the columns of `reprocess` first, then everything else a row knows."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from itertools import islice
from typing import Any, TextIO

import numpy as np

from core.results import Measurement
from daemon.reports.slot_table import COLUMNS, kind_of_column
from daemon.store.columns import BATCH, Columns
from daemon.store.convert import BURST_COLUMNS, RESULT_COLUMNS, measurement_columns
from daemon.store.records import MeasurementRecord
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
    results: Iterable[tuple[datetime, Measurement]], output: TextIO, *, bursts: bool = False
) -> int:
    """Write slots and what was measured in them; give the number of rows.

    `bursts` appends the columns of slots with several pairs.
    """
    names = RESULT_COLUMNS + (BURST_COLUMNS if bursts else ())
    rows = (
        measurement_columns(MeasurementRecord(slot_utc, measurement, config_hash="", version=""))
        | {"slot_utc": slot_text(slot_utc)}
        for slot_utc, measurement in results
    )
    table = _Table(output, names)
    while batch := list(islice(rows, BATCH)):
        table.write({name: [row.get(name) for row in batch] for name in names})
    return table.rows


def write_slots(slots: Iterable[Columns], output: TextIO) -> int:
    """Write every slot of `slot_table` with all its columns; give the number of rows.

    Numbers have the digits that `DECIMALS` says; what a slot does not have is empty.
    """
    table = _Table(output, COLUMNS)
    for batch in slots:
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
    if kind == "real":
        return _real_cells(values, DECIMALS[name.rpartition("_")[2]])
    if kind == "truth":
        return [_TRUTHS[value] for value in values]
    return ["" if value is None else str(value) for value in values]


def _real_cells(values: Sequence[float | None], decimals: int) -> list[str]:
    numbers = np.round(np.array(values, dtype=np.float64), decimals) + 0.0  # no -0.0
    pairs = zip(values, numbers.tolist(), strict=True)
    return ["" if value is None else repr(number) for value, number in pairs]
