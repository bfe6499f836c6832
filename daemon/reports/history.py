"""A stretch of the record as `plot` and `report` show it, read in one pass."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from core.arrays import FloatArray
from core.results import Flag
from daemon.errors import WorkFailedError
from daemon.reports.figure import GapSpan
from daemon.reports.series import BINS, Envelope, Points, Series
from daemon.store.columns import Columns, Tell, read_columns
from daemon.store.database import Store
from daemon.store.records import Coverage, GapRecord
from daemon.text import utc_text

MOST_POINTS = 2 * BINS
"""More rows than this are drawn as their envelope."""


@dataclass(frozen=True, slots=True)
class Month:
    """The good rows of a month, in mm."""

    name: str
    rows: int
    mean_mm: tuple[float, float]
    lowest_mm: tuple[float, float]
    highest_mm: tuple[float, float]
    median_sigma_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class History:
    """A stretch of the record."""

    since_utc: datetime
    until_utc: datetime
    """The first slot after it."""
    coverage: Coverage
    gaps: tuple[GapRecord, ...]
    series: Series
    months: tuple[Month, ...]
    reasons: tuple[tuple[str, int], ...]
    """Of the rows that are not good, by number."""
    calibrations: tuple[int, ...]
    """Those that rows were measured with."""


def read_history(
    store: Store,
    since: datetime | None,
    until: datetime | None,
    *,
    period_s: int,
    offset_s: int,
    tell: Tell,
) -> History:
    """Read what there is from `since` to `until`. Raises StoreError, WorkFailedError if nothing."""
    since_utc, until_utc = _span(store, since, until)
    coverage = store.coverage(since_utc, until_utc, period_s=period_s, offset_s=offset_s)
    fits = coverage.measured <= MOST_POINTS
    drawn = Points() if fits else Envelope(since_utc, until_utc)
    summary = Summary()
    for rows in read_columns(store.path, since_utc, until_utc, tell):
        drawn.add(rows)
        summary.add(rows)
    return History(
        since_utc=since_utc,
        until_utc=until_utc,
        coverage=coverage,
        gaps=tuple(store.gaps(since_utc, until_utc)),
        series=drawn.series(),
        months=summary.months(),
        reasons=tuple(summary.reasons.most_common()),
        calibrations=tuple(sorted(summary.calibrations)),
    )


def _span(
    store: Store, since: datetime | None, until: datetime | None
) -> tuple[datetime, datetime]:
    accounted = store.accounted()
    if accounted is None:
        msg = f"{store.path}: holds no slot yet; start dcamd, or name another --state"
        raise WorkFailedError(msg)
    first_utc = max(since or accounted[0], accounted[0])
    end_utc = min(until or accounted[1] + timedelta(seconds=1), accounted[1] + timedelta(seconds=1))
    if first_utc >= end_utc:
        known = f"{utc_text(accounted[0])} to {utc_text(accounted[1])}"
        msg = f"{store.path}: no slots in this span; there are slots from {known}"
        raise WorkFailedError(msg)
    return first_utc, end_utc


class Summary:
    """Figures of rows as they come: 32 bytes of each good one are kept."""

    def __init__(self) -> None:
        self.reasons: Counter[str] = Counter()
        self.calibrations: set[int] = set()
        self._months: dict[str, array[float]] = {}

    def add(self, rows: Columns) -> None:
        """Take rows, in the order of their slots."""
        for joined, count in Counter(rows.values["reasons"]).items():
            self.reasons.update(dict.fromkeys(filter(None, joined.split("+")), count))
        self.calibrations.update(set(rows.values["calibration_id"]) - {None})
        good = np.array(rows.values["flag"]) == Flag.GOOD
        values = rows.numbers("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
        months = np.array([slot[:7] for slot in rows.values["slot_utc"]])
        for name in dict.fromkeys(months.tolist()):
            chosen = values[good & (months == name)]
            self._months.setdefault(name, array("d")).frombytes(chosen.tobytes())

    def months(self) -> tuple[Month, ...]:
        """The good rows by month."""
        months = {name: np.array(kept).reshape(-1, 4) for name, kept in self._months.items()}
        return tuple(_month(name, values) for name, values in months.items() if len(values))


def _month(name: str, values: FloatArray) -> Month:
    mm, sigma_mm = values[:, :2], values[:, 2:]

    def pair(numbers: FloatArray) -> tuple[float, float]:
        return float(numbers[0]), float(numbers[1])

    return Month(
        name=name,
        rows=len(values),
        mean_mm=pair(mm.mean(axis=0)),
        lowest_mm=pair(mm.min(axis=0)),
        highest_mm=pair(mm.max(axis=0)),
        median_sigma_mm=pair(np.median(sigma_mm, axis=0)),
    )


def gap_spans(gaps: Sequence[GapRecord]) -> list[GapSpan]:
    """Gaps as a figure shows them: from half a period before the first slot to half after."""
    half = [timedelta(seconds=gap.period_s / 2) for gap in gaps]
    return [
        GapSpan(gap.first_slot_utc - wide, gap.last_slot_utc + wide, gap.cause.value)
        for gap, wide in zip(gaps, half, strict=True)
    ]
