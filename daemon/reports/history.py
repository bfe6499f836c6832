"""A stretch of the record as `plot` and `report` show it, read in one pass."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from core.arrays import FloatArray
from core.results import Flag
from core.site import MAIN, TargetRole
from daemon.reports.figure import GapSpan
from daemon.reports.series import BINS, CAMERAS, Channel, Envelope, Points, Series
from daemon.store.database import Store
from daemon.store.ledger.entries import Span, excluded_spans, read_ledger, span_numbers
from daemon.store.queries.columns import Columns, Tell, read_columns, target_roles
from daemon.store.queries.sensors import Sensor, sensor_columns, sensors_within
from daemon.store.recorded_span import recorded_span
from daemon.store.records import Coverage, GapRecord
from daemon.store.rows.targets import columns_of_target, text_without_target, values_of_targets
from daemon.time_arrays import utc_array
from daemon.times import EPOCH

MOST_POINTS = 2 * BINS
"""More rows than this are drawn as their envelope."""

_VALUES = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
_OF_MAIN = (*_VALUES, "raw_x_mm", "raw_y_mm")
_OF_TARGET = ("flag", *_VALUES)


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
class ClosureMonth:
    """What fixed targets showed of the rig's error in a month, in mm: rms of x and of y."""

    name: str
    rows: int
    rms_mm: tuple[float, float]
    sigma_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class TargetHistory:
    """A further target, in mm; of its good rows."""

    name: str
    role: str
    rows: int
    """That name it, whatever they say of it."""
    good: Month | None
    """All of the span together; None without any good row."""


@dataclass(frozen=True, slots=True)
class ReadingSummary:
    """What a sensor, or a camera of itself, has said."""

    name: str
    unit: str
    rows: int
    """Those with a value."""
    mean: float
    lowest: float
    highest: float


@dataclass(frozen=True, slots=True)
class GoodRows:
    """How certain the good rows are, by the worse of both axes."""

    rows: int
    median_slot_utc: datetime
    """Of a row with the median sigma."""
    median_sigma_mm: float
    p95_sigma_mm: float
    """That 95 % of them do not exceed."""
    largest_sigma_mm: float


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
    months_without: tuple[Month, ...]
    """Without what the quality ledger excludes; empty where it excludes none of these rows."""
    good: GoodRows | None
    """None without any."""
    closures: tuple[ClosureMonth, ...]
    targets: tuple[TargetHistory, ...]
    """The further targets that rows name."""
    reasons: tuple[tuple[str, int], ...]
    """Of the rows that are not good, by number."""
    calibrations: tuple[int, ...]
    """Those that rows were measured with."""
    readings: tuple[ReadingSummary, ...]
    excluded: tuple[Span, ...]
    """Spans of the whole record whose values of the main target the quality ledger leaves out."""


def read_history(
    store: Store,
    since: datetime | None,
    until: datetime | None,
    *,
    period_s: int,
    offset_s: int,
    tell: Tell,
    without_excluded: bool = False,
    also: Callable[[Columns], None] = lambda _rows: None,
) -> History:
    """Read what there is from `since` to `until`.

    `without_excluded` leaves what the quality ledger excludes out of the series. `also` is given
    the rows as they are read, whole. Raises StoreError, WorkFailedError if nothing is there.
    """
    since_utc, until_utc = recorded_span(store, since, until)
    coverage = store.coverage(since_utc, until_utc, period_s=period_s, offset_s=offset_s)
    roles = target_roles(store.path, since_utc, until_utc)
    drawn_targets = [name for name, role in roles.items() if role == TargetRole.MEASURED]
    fits = coverage.measured <= MOST_POINTS
    sensors = sensors_within(store.path, since_utc, until_utc)
    channels = (*CAMERAS, *(Channel(sensor.name, sensor.unit) for sensor in sensors))
    names = drawn_targets, channels
    drawn = Points(*names) if fits else Envelope(since_utc, until_utc, *names)
    entries = read_ledger(store.path)
    excluded = excluded_spans(entries)
    hidden = {
        point: excluded_spans(entries, point) if without_excluded else []
        for point in (MAIN, *drawn_targets)
    }
    summary = Summary(roles, excluded)
    said = Readings(channels)
    for rows in read_columns(store.path, since_utc, until_utc, tell):
        readings = _readings(rows, sensors)
        drawn.add(_without(rows, hidden), readings)
        summary.add(rows)
        said.add(readings)
        also(rows)
    return History(
        since_utc=since_utc,
        until_utc=until_utc,
        coverage=coverage,
        gaps=tuple(store.gaps(since_utc, until_utc)),
        series=drawn.series(),
        months=summary.months(),
        months_without=summary.months_without(),
        good=summary.good(),
        closures=summary.closures(),
        targets=summary.targets(),
        reasons=tuple(summary.reasons.most_common()),
        calibrations=tuple(sorted(summary.calibrations)),
        readings=said.summaries(),
        excluded=tuple(excluded),
    )


def _without(rows: Columns, hidden: Mapping[str, Sequence[Span]]) -> Columns:
    """Rows as if each point had no value in its hidden spans."""
    times, values = utc_array(rows.values["slot_utc"]), dict(rows.values)
    for point, spans in hidden.items():
        out = np.flatnonzero(span_numbers(times, spans) >= 0).tolist()
        columns = (*_OF_MAIN, "flag") if point == MAIN else ("targets",)
        for name in columns if out else ():
            column = values[name] = list(values[name])
            for place in out:
                if point != MAIN:
                    column[place] = text_without_target(column[place], point)
                else:  # a flag that is neither suspect nor withheld
                    column[place] = int(Flag.MISSING) if name == "flag" else None
    return Columns(values)


def _readings(rows: Columns, sensors: Sequence[Sensor]) -> FloatArray:
    """(rows, channels) the cameras' temperatures, then the sensors' readings."""
    cameras = rows.numbers("main_temperature_c", "sub_temperature_c")
    columns = sensor_columns(rows.values["readings"], sensors)
    said = [np.array(columns[sensor.column], dtype=np.float64)[:, None] for sensor in sensors]
    return np.hstack([cameras, *said])


class Summary:
    """Figures of rows as they come: 48 bytes of each good one are kept."""

    def __init__(self, roles: Mapping[str, str], excluded: Sequence[Span] = ()) -> None:
        self._roles, self._excluded = roles, excluded
        self._left_out: dict[str, array[int]] = {}
        self._named = Counter[str]()
        self._targets = {name: array("d") for name in roles}
        self._closures: dict[str, array[float]] = {}
        self.reasons: Counter[str] = Counter()
        self.calibrations: set[int] = set()
        self._months: dict[str, array[float]] = {}
        self._slots, self._sigmas = array("q"), array("d")

    def add(self, rows: Columns) -> None:
        """Take rows, in the order of their slots."""
        for joined, count in Counter(rows.values["reasons"]).items():
            self.reasons.update(dict.fromkeys(filter(None, joined.split("+")), count))
        self.calibrations.update(set(rows.values["calibration_id"]) - {None})
        good = np.array(rows.values["flag"]) == Flag.GOOD
        values = rows.numbers(*_VALUES)
        slots_us = utc_array(rows.values["slot_utc"]).astype(np.int64)
        self._slots.frombytes(slots_us[good].tobytes())
        self._sigmas.frombytes(values[good, 2:].max(axis=1).tobytes())
        closures = rows.numbers(*(f"closure_{name}" for name in _VALUES))
        closed = np.isfinite(closures[:, 0])
        months = np.array([slot[:7] for slot in rows.values["slot_utc"]])
        left_out = span_numbers(slots_us.astype("datetime64[us]"), self._excluded) >= 0
        for name in dict.fromkeys(months.tolist()):
            marks = left_out[good & (months == name)].astype(np.int8)
            self._left_out.setdefault(name, array("b")).frombytes(marks.tobytes())
            for kept, chosen in (
                (self._months, values[good & (months == name)]),
                (self._closures, closures[closed & (months == name)]),
            ):
                kept.setdefault(name, array("d")).frombytes(chosen.tobytes())
        self._add_targets(rows)

    def _add_targets(self, rows: Columns) -> None:
        names = list(self._roles)
        found = values_of_targets(rows.values["targets"], names, _OF_TARGET)
        for name in names:
            flags, *columns = (found[column] for column in columns_of_target(name, _OF_TARGET))
            self._named[name] += len(flags) - flags.count(None)
            values = np.array(columns, dtype=np.float64).T
            good = np.array([flag == Flag.GOOD for flag in flags], dtype=np.bool_)
            self._targets[name].frombytes(values[good].tobytes())

    def months(self) -> tuple[Month, ...]:
        """The good rows by month."""
        months = {name: np.array(kept).reshape(-1, 4) for name, kept in self._months.items()}
        return tuple(_month(name, values) for name, values in months.items() if len(values))

    def months_without(self) -> tuple[Month, ...]:
        """The good rows by month, without those excluded; empty where none is."""
        if not any(any(marks) for marks in self._left_out.values()):
            return ()
        months = {
            name: np.array(kept).reshape(-1, 4)[np.array(self._left_out[name]) == 0]
            for name, kept in self._months.items()
        }
        return tuple(_month(name, values) for name, values in months.items() if len(values))

    def good(self) -> GoodRows | None:
        """How certain the good rows are."""
        if not self._sigmas:
            return None
        sigmas = np.array(self._sigmas)
        order = np.argsort(sigmas, kind="stable")
        middle = int(order[(len(order) - 1) // 2])
        return GoodRows(
            rows=len(sigmas),
            median_slot_utc=EPOCH + timedelta(microseconds=self._slots[middle]),
            median_sigma_mm=float(sigmas[middle]),
            p95_sigma_mm=float(np.quantile(sigmas, 0.95)),
            largest_sigma_mm=float(sigmas.max()),
        )

    def closures(self) -> tuple[ClosureMonth, ...]:
        """The closures by month."""
        months = {name: np.array(kept).reshape(-1, 4) for name, kept in self._closures.items()}
        return tuple(
            ClosureMonth(name, len(values), _pair(rms[:2]), _pair(rms[2:]))
            for name, values in months.items()
            if len(values)
            for rms in (np.sqrt((values**2).mean(axis=0)),)
        )

    def targets(self) -> tuple[TargetHistory, ...]:
        """The further targets, in their order."""
        good = {name: np.array(kept).reshape(-1, 4) for name, kept in self._targets.items()}
        return tuple(
            TargetHistory(
                name, role, self._named[name], _month("", good[name]) if len(good[name]) else None
            )
            for name, role in self._roles.items()
        )


class Readings:
    """Figures of readings as they come."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = channels
        self._counts = np.zeros(len(channels), dtype=np.int64)
        self._sums = np.zeros(len(channels))
        self._lowest = np.full(len(channels), np.inf)
        self._highest = -self._lowest

    def add(self, readings: FloatArray) -> None:
        """Take those of some rows, (rows, channels)."""
        self._counts += np.isfinite(readings).sum(axis=0)
        self._sums += np.nansum(readings, axis=0)
        self._lowest = np.fmin(self._lowest, np.fmin.reduce(readings, axis=0))
        self._highest = np.fmax(self._highest, np.fmax.reduce(readings, axis=0))

    def summaries(self) -> tuple[ReadingSummary, ...]:
        """Those that have said something."""
        numbers = zip(
            self._channels,
            *(self._counts.tolist(), self._sums.tolist()),
            *(self._lowest.tolist(), self._highest.tolist()),
            strict=True,
        )
        return tuple(
            ReadingSummary(channel.label, channel.unit, count, total / count, low, high)
            for channel, count, total, low, high in numbers
            if count
        )


def _month(name: str, values: FloatArray) -> Month:
    mm, sigma_mm = values[:, :2], values[:, 2:]
    return Month(
        name=name,
        rows=len(values),
        mean_mm=_pair(mm.mean(axis=0)),
        lowest_mm=_pair(mm.min(axis=0)),
        highest_mm=_pair(mm.max(axis=0)),
        median_sigma_mm=_pair(np.median(sigma_mm, axis=0)),
    )


def _pair(numbers: FloatArray) -> tuple[float, float]:
    return float(numbers[0]), float(numbers[1])


def gap_spans(gaps: Sequence[GapRecord]) -> list[GapSpan]:
    """Gaps as a figure shows them: from half a period before the first slot to half after."""
    half = [timedelta(seconds=gap.period_s / 2) for gap in gaps]
    return [
        GapSpan(gap.first_slot_utc - wide, gap.last_slot_utc + wide, gap.cause.value)
        for gap, wide in zip(gaps, half, strict=True)
    ]
