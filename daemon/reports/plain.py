"""Measurements as a small table for spreadsheets: local time, the values, what to think of them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from datetime import datetime, tzinfo
from typing import Any, TextIO

import numpy as np

from core.results import Flag
from core.site import MAIN
from daemon.reports.slot_table import SlotTable
from daemon.store.ledger.entries import ALL_POINTS

DECIMALS = {"mm": 4, "c": 2}
"""A tenth of a micrometre, a hundredth of a degree, by the unit that a name ends in."""
_MOST_DIGITS = 6
"""Of readings, whose units are the site's."""

_VALUES = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
MAIN_POINTS = {MAIN, ALL_POINTS}
"""What the ledger calls the main target."""
_WORDS = {int(flag): flag.name.lower() for flag in Flag}


def write_plain(slots: SlotTable, output: TextIO, zone: tzinfo, *, comma: bool = False) -> int:
    """Write every slot with the columns that a spreadsheet is drawn from; give the number of rows.

    The time is what a clock in the zone shows, as spreadsheets read times, with its offset from UTC
    beside it: an hour that comes twice is two. `comma` writes decimal commas, and semicolons
    between columns, as spreadsheets of many countries want it.
    """
    further = [
        f"{name}_{axis}_mm"
        for name, role in slots.roles.items()
        if role == "measured"
        for axis in "xy"
    ]
    sensors = [sensor.column for sensor in slots.sensors]
    numbers = [*_VALUES, *further, "main_temperature_c", *sensors]
    lines = csv.writer(output, delimiter=";" if comma else ",", lineterminator="\n")
    lines.writerow(["local_time", "utc_offset", *numbers[:4], "quality", "reasons", *numbers[4:]])
    count = 0
    for batch in slots.batches:
        times, offsets = _local(batch.values["slot_utc"], zone)
        values = [_cells(name, batch.values[name], comma=comma) for name in numbers]
        quality = [
            "excluded" if names and MAIN_POINTS & set(names.split("+")) else _WORDS[flag]
            for flag, names in zip(batch.values["flag"], batch.values["excluded"], strict=True)
        ]
        reasons = [why or "" for why in batch.values["reasons"]]
        columns = [times, offsets, *values[:4], quality, reasons, *values[4:]]
        lines.writerows(zip(*columns, strict=True))
        count += len(batch)
    return count


def _local(slots: Sequence[str], zone: tzinfo) -> tuple[list[str], list[str]]:
    """`2026-03-29 03:00:00` and `+02:00` of each slot."""
    texts = [datetime.fromisoformat(slot).astimezone(zone).isoformat(" ") for slot in slots]
    return [text[:19] for text in texts], [text[19:] for text in texts]


def _cells(name: str, values: Sequence[Any], *, comma: bool) -> list[str]:
    decimals = DECIMALS.get(name.rpartition("_")[2])
    if decimals is None:
        cells = ["" if value is None else f"{value:.{_MOST_DIGITS}g}" for value in values]
    else:
        rounded = np.round(np.array(values, dtype=np.float64), decimals) + 0.0  # no -0.0
        pairs = zip(values, rounded.tolist(), strict=True)
        cells = ["" if value is None else f"{number:.{decimals}f}" for value, number in pairs]
    return [cell.replace(".", ",") for cell in cells] if comma else cells
