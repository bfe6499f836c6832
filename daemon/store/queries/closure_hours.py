"""What fixed targets showed, as means of the hours: small enough to fit, whatever the record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.results import Flag
from core.rig.learning import TargetHours
from core.site import TargetRole
from daemon.store.queries.columns import Columns, Tell, read_columns
from daemon.store.rows.hourly_closures import HOUR, middle_of_hour_s
from daemon.store.rows.targets import stored_targets

_DAY_S = 86_400.0

Key = tuple[int, str]
"""A calibration and an hour."""


@dataclass(slots=True)
class ClosureHours:
    """Sums of the hours of a record."""

    warmth: dict[Key, FloatArray] = field(default_factory=dict)
    """(2,) sum of the cameras' temperatures (the main one's, else the other's), and how many."""
    closure: dict[Key, dict[str, FloatArray]] = field(default_factory=dict)
    """(5,) by target: sums of x, y (mm), their variances by the pixels, and how many."""

    def add(self, columns: Columns) -> None:
        """Add rows. Only what good fixed targets show."""
        values = columns.values
        names = (
            *("slot_utc", "calibration_id", "main_temperature_c", "sub_temperature_c"),
            "targets",
        )
        for slot, calibration, main_c, sub_c, text in zip(*(values[n] for n in names), strict=True):
            celsius = sub_c if main_c is None else main_c
            if calibration is None or celsius is None:
                continue
            key = (calibration, slot[:HOUR])
            self.warmth.setdefault(key, np.zeros(2))[:] += celsius, 1.0
            for seen in stored_targets(text):
                if seen["role"] == TargetRole.FIXED and seen["flag"] == Flag.GOOD:
                    sums = self.closure.setdefault(key, {})
                    sums.setdefault(seen["name"], np.zeros(5))[:] += _summed(seen)

    def of(
        self, references_s: Mapping[int, float], distances_mm: Mapping[str, float]
    ) -> TargetHours:
        """The hours of some calibrations, by the seconds (since 1970) of their references."""
        names = list(distances_mm)
        keys = sorted(key for key in self.warmth if key[0] in references_s)
        hours_s = np.array([middle_of_hour_s(hour) for _, hour in keys])
        since_s = hours_s - np.array([references_s[number] for number, _ in keys])
        later = since_s > 0.0
        keys = [key for key, kept in zip(keys, later, strict=True) if kept]
        nothing = np.full(5, math.nan)
        sums = np.array(
            [[self.closure.get(key, {}).get(name, nothing) for name in names] for key in keys]
        ).reshape(len(keys), len(names), 5)
        return TargetHours(
            np.array([number for number, _ in keys], dtype=np.int64),
            since_s[later] / _DAY_S,
            np.array([self.warmth[key][0] / self.warmth[key][1] for key in keys]),
            sums[:, :, :2] / sums[:, :, 4:],
            sums[:, :, 2:4] / sums[:, :, 4:] ** 2,
            np.array([distances_mm[name] for name in names]),
        )


def read_closure_hours(
    path: Path, since: datetime, until: datetime, tell: Tell = lambda _done, _total: None
) -> ClosureHours:
    """The hours of rows with since <= slot < until. Raises StoreError."""
    hours = ClosureHours()
    for batch in read_columns(path, since, until, tell, as_stored=True):
        hours.add(batch)
    return hours


def _summed(seen: Mapping[str, float]) -> Sequence[float]:
    sigmas = (seen.get(f"sigma_image_{axis}_mm", seen[f"sigma_{axis}_mm"]) for axis in "xy")
    return (seen["x_mm"], seen["y_mm"], *(sigma**2 for sigma in sigmas), 1.0)
