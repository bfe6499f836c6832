"""The record beside a reference; of a long record only the rows near its times are read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from core.analysis.comparison import NOT_SOUGHT, Comparison, TimedValues, Zero, compare
from core.arrays import FloatArray
from core.results import Flag
from core.site import MAIN
from daemon.errors import WorkFailedError
from daemon.reports.figure import ReferenceMarks
from daemon.reports.reference import Reference, read_reference
from daemon.store.ledger.entries import read_ledger
from daemon.store.ledger.exclusion import ExcludedRows, Exclusion
from daemon.store.queries.columns import Columns, read_columns
from daemon.store.rows.targets import columns_of_target, stored_targets, values_of_targets
from daemon.time_arrays import utc_array
from daemon.times import EPOCH

_OF_TARGET = ("flag", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")


@dataclass(frozen=True, slots=True)
class Settings:
    """How the two are held against one another."""

    window_s: float = 300.0
    """Rows within this of a time of the reference are averaged."""
    zero: Zero = Zero.FREE
    max_lag_s: float | None = None
    """None: no lag is sought."""
    with_excluded: bool = False
    """Whether what the quality ledger excludes is taken in."""


@dataclass(frozen=True, slots=True)
class PointComparison:
    """One axis of one point."""

    point: str
    axis: str
    times: int
    """Of the reference within the span."""
    found: Comparison | None
    """None where no good row is near any of its times."""
    excluded: ExcludedRows
    """Of the good rows near its times."""


@dataclass(frozen=True, slots=True)
class Beside:
    """A reference, and the record beside it."""

    reference: Reference
    comparisons: tuple[PointComparison, ...]
    marks: tuple[ReferenceMarks, ...]
    """The reference in the record's zero, to be drawn; without those points that no row is near."""


def read_beside(
    path: Path, file: Path, zero: str, window_s: float, since: datetime, until: datetime
) -> Beside:
    """Read a reference for figures and reports of a span.

    Raises StoreError, HardwareError, WorkFailedError.
    """
    reference = read_reference(file)
    settings = Settings(window_s, Zero(zero))
    comparisons = compare_with_reference(path, reference, settings, since, until)
    marks = []
    for one in comparisons:
        if one.found is None:
            continue
        values = _within(reference.series[one.point, one.axis], since, until)
        times = (values.times_s * 1e6).astype("datetime64[us]")
        mm = values.values_mm + one.found.offset_mm
        marks.append(ReferenceMarks(one.point, one.axis, times, mm, 2.0 * values.sigma_mm))
    return Beside(reference, comparisons, tuple(marks))


def compare_with_reference(
    path: Path,
    reference: Reference,
    settings: Settings,
    since: datetime | None = None,
    until: datetime | None = None,
) -> tuple[PointComparison, ...]:
    """Compare the good rows of a database with a reference, by point and axis.

    Without those that the quality ledger excludes, unless the settings take them in. Only times of
    the reference from `since` to `until` count. Raises StoreError, WorkFailedError for a point that
    the rows near it do not name.
    """
    series = {key: _within(values, since, until) for key, values in reference.series.items()}
    entries = read_ledger(path)
    exclusions = {
        key: Exclusion(entries, key[0], with_excluded=settings.with_excluded) for key in series
    }
    asked = {key: mm for key, mm in series.items() if len(mm)}
    rows = _rows_near(path, asked, settings, exclusions, reference.name)
    return tuple(
        PointComparison(
            *key,
            len(values),
            compare(
                rows[key],
                values,
                window_s=settings.window_s,
                zero=settings.zero,
                max_lag_s=settings.max_lag_s,
            )
            if len(values)
            else None,
            exclusions[key].found(),
        )
        for key, values in series.items()
    )


def _within(values: TimedValues, since: datetime | None, until: datetime | None) -> TimedValues:
    first = -np.inf if since is None else since.timestamp()
    end = np.inf if until is None else until.timestamp()
    kept = (values.times_s >= first) & (values.times_s < end)
    return TimedValues(values.times_s[kept], values.values_mm[kept], values.sigma_mm[kept])


def _rows_near(
    path: Path,
    series: Mapping[tuple[str, str], TimedValues],
    settings: Settings,
    exclusions: Mapping[tuple[str, str], Exclusion],
    reference: str,
) -> dict[tuple[str, str], TimedValues]:
    """Good rows within reach of any time of the reference, by point and axis."""
    kept: dict[tuple[str, str], list[FloatArray]] = {key: [] for key in series}
    others, known = {point for point, _ in series} - {MAIN}, set[str]()
    for since, until in _windows(series, settings.window_s + (settings.max_lag_s or 0.0)):
        for rows in read_columns(path, since, until):
            if others:
                known.update(target["name"] for target in _targets(rows))
            for key in series:
                kept[key].append(_values(rows, *key, exclusions[key]))
    if not others <= known:
        msg = (
            f'{reference}: no row near its times names the point "{min(others - known)}"; there '
            f"are {', '.join((MAIN, *sorted(known)))}"
        )
        raise WorkFailedError(msg)
    found = {}
    for key, parts in kept.items():
        values = np.concatenate([np.empty((0, 3)), *parts])
        found[key] = TimedValues(*values.T)
    return found


def _windows(
    series: Mapping[tuple[str, str], TimedValues], reach_s: float
) -> Iterator[tuple[datetime, datetime]]:
    """Spans that hold all rows within reach of a time, those that touch as one."""
    if not series:
        return
    times_s = np.unique(np.concatenate([values.times_s for values in series.values()]))
    parts = np.split(times_s, np.flatnonzero(np.diff(times_s) > 2.0 * reach_s + 1.0) + 1)
    for part in parts:
        first, last = float(part[0]), float(part[-1])
        yield _moment(first - reach_s), _moment(last + reach_s) + timedelta(microseconds=1)


def _moment(seconds: float) -> datetime:
    """A time that the calendar has: a reference may be of any year."""
    least, most = datetime(1970, 1, 1, tzinfo=UTC), datetime(9000, 1, 1, tzinfo=UTC)
    return EPOCH + timedelta(seconds=min(max(seconds, 0.0), (most - least).total_seconds()))


def _targets(rows: Columns) -> Iterator[dict[str, Any]]:
    """The further targets of rows, each distinct text looked at once."""
    for text in set(rows.values["targets"]):
        yield from stored_targets(text)


def _values(rows: Columns, point: str, axis: str, exclusion: Exclusion) -> FloatArray:
    """(n, 3) time, value and sigma of the good rows of a point that stay."""
    if point == MAIN:
        flags = np.array(rows.values["flag"], dtype=np.float64)
        numbers = rows.numbers(f"{axis}_mm", f"sigma_{axis}_mm")
    else:
        found = values_of_targets(rows.values["targets"], [point], _OF_TARGET)
        flags = np.array(found[f"{point}_flag"], dtype=np.float64)
        names = columns_of_target(point, (f"{axis}_mm", f"sigma_{axis}_mm"))
        numbers = np.array([found[name] for name in names], dtype=np.float64).T
    good = (flags == Flag.GOOD) & np.isfinite(numbers).all(axis=1)
    kept = exclusion.keep(rows.values["slot_utc"], good)
    times_s = utc_array(rows.values["slot_utc"]).astype(np.int64) * 1e-6
    return np.asarray(np.column_stack([times_s, numbers])[kept])


def sentences(one: PointComparison) -> list[str]:
    """What one axis of one point comes to, in plain sentences."""
    what, found = f"{one.point} {one.axis}", one.found
    excluded = [f"{what}: {line}"] if (line := one.excluded.sentence()) else []
    if found is None:
        why = f"{what}: no good row near any of {one.times} times of the reference"
        return [*excluded, why]
    count = len(found.differences)
    lines = [
        *excluded,
        f"{what}: {count} of {one.times} times of the reference have good rows near them",
        f"{what}: rows less reference: mean {found.bias_mm:+.3f} mm, {_zero_words(found)}",
        f"{what}: what is left of the differences: {found.rms_mm:.3f} mm rms",
    ]
    if found.correlation is not None:
        lines.append(f"{what}: correlation {found.correlation:.3f}")
    if found.lag is not None:
        lag_min, sigma_min = found.lag.lag_s / 60.0, found.lag.sigma_s / 60.0
        lines.append(
            f"{what}: the reference moves {abs(lag_min):.1f} ± {sigma_min:.1f} min (1 sigma) "
            f"{'later' if lag_min >= 0 else 'earlier'} than the rows"
        )
    elif found.no_lag != NOT_SOUGHT:
        lines.append(f"{what}: no lag: {found.no_lag}")
    return [*lines, f"{what}: {_verdict(found)}"]


def _zero_words(found: Comparison) -> str:
    if found.zero is Zero.FIXED:
        return "both count from one zero"
    return (
        f"zeros free: {found.offset_mm:+.3f} ± {found.offset_sigma_mm:.3f} mm (1 sigma) taken off"
    )


def _verdict(found: Comparison) -> str:
    if found.agrees is None or found.largest_e_n is None:
        return "a single time with a free zero says nothing; give more times, or a fixed zero"
    count = len(found.differences)
    numbers = f"E_n up to {found.largest_e_n:.2f}, {found.beyond} of {count} above 1"
    if found.agrees:
        return f"the two agree within their uncertainties ({numbers})"
    return f"the two do NOT agree within their uncertainties ({numbers})"
