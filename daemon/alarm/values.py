"""The alarms that a site defines on its values: read from the record, judged by `core`."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from core.analysis.alarm_rules import LEAST_ROWS, Judged, Limits, Samples, judge_level, judge_rate
from daemon.alarm.wrong import Wrong, level_of
from daemon.config.alarm import AlarmSection, RateAlarm, ReadingAlarm, ValueAlarm
from daemon.store.queries.point_rows import PointRows, open_points, point_rows, reading_rows
from daemon.text import utc_text

SECOND = timedelta(seconds=1)
STALE_PERIODS = 5
"""Rows older than the dwell time and so many periods say nothing of now."""

Own = ValueAlarm | RateAlarm | ReadingAlarm


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the rows say of one alarm that the site defines."""

    alarm: Own
    wrong: Wrong | None
    """None where all is well."""
    is_known: bool
    """Whether the rows say anything; else the alarm stays as it was."""
    limit: float | None = None
    """The limit that the value is beyond; kept for the hysteresis."""
    now: str = ""
    """The value as people read it."""


def judge_values(
    settings: AlarmSection,
    state: Path,
    period_s: int,
    now_utc: datetime,
    raised: Mapping[str, float],
) -> list[Verdict]:
    """Judge each alarm of the site; `raised` are the limits that are exceeded now, by name.

    Raises StoreError.
    """
    if not settings.own:
        return []
    with open_points(state) as connection:
        return [
            judge_rows(
                one,
                _rows(connection, one, period_s, now_utc),
                period_s,
                now_utc,
                raised.get(one.name),
            )
            for one in settings.own
        ]


def _rows(connection: sqlite3.Connection, one: Own, period_s: int, now_utc: datetime) -> PointRows:
    span_s = 3600 * one.window_h if isinstance(one, RateAlarm) else 60 * one.dwell_min
    reach_s = max(span_s, LEAST_ROWS * period_s) + STALE_PERIODS * period_s
    since_utc, until_utc = now_utc - timedelta(seconds=reach_s), now_utc + SECOND
    if isinstance(one, ReadingAlarm):
        return reading_rows(connection, one.reading, since_utc, until_utc)
    return point_rows(connection, one.target, one.axis, since_utc, until_utc)


def judge_rows(
    one: Own, found: PointRows, period_s: int, now_utc: datetime, raised: float | None
) -> Verdict:
    """Judge one alarm by its rows up to now; `raised` is the limit that is exceeded now."""
    samples = samples_of(found)
    judged = _judged(one, samples, raised) if _is_fresh(samples, period_s, now_utc) else None
    if judged is None:
        return Verdict(one, None, is_known=False, limit=raised, now="no rows that tell")
    value = _value_text(one, judged)
    if judged.limit is None:
        return Verdict(one, None, is_known=True, now=value)
    text = _text(one, judged, found, value)
    wrong = Wrong(one.name, level_of(one.severity), text, at_once=True)
    return Verdict(one, wrong, is_known=True, limit=judged.limit, now=value)


def samples_of(found: PointRows) -> Samples:
    """The rows as arrays."""
    rows = found.rows
    return Samples(
        np.array([row.time_s for row in rows], dtype=float),
        np.array([row.value for row in rows], dtype=float),
        np.array([row.sigma for row in rows], dtype=float),
    )


def _is_fresh(samples: Samples, period_s: int, now_utc: datetime) -> bool:
    if not samples.time_s.size:
        return False
    return bool(now_utc.timestamp() - samples.time_s[-1] <= STALE_PERIODS * period_s)


def _judged(one: Own, samples: Samples, raised: float | None) -> Judged | None:
    if isinstance(one, RateAlarm):
        return judge_rate(
            *(samples, one.limit_mm_per_day, one.hysteresis, one.sigmas, 3600 * one.window_h),
            raised=raised is not None,
        )
    if isinstance(one, ValueAlarm):
        limits = Limits(one.above_mm, one.below_mm, one.hysteresis_mm, one.sigmas)
    else:
        limits = Limits(one.above, one.below, one.hysteresis, 0.0)
    return judge_level(samples, limits, 60 * one.dwell_min, raised)


def _value_text(one: Own, judged: Judged) -> str:
    if isinstance(one, ReadingAlarm):
        return f"{one.reading} {judged.value:g}"
    unit = "mm/d" if isinstance(one, RateAlarm) else "mm"
    return f"{one.target} {one.axis} {judged.value:+.3f} ± {judged.sigma:.3f} {unit}"


def _text(one: Own, judged: Judged, found: PointRows, value: str) -> str:
    """What, where, how much, with which sigma, of which rows, and what to do."""
    limit = judged.limit or 0.0
    last = utc_text(datetime.fromtimestamp(judged.until_s, UTC))
    if isinstance(one, ReadingAlarm):
        side = "above" if limit == one.above else "below"
        text = f"{value}, {side} {limit:g} over {one.dwell_min:g} min (row of {last})"
        return f"{text}: look at heater, fan, shade and sensor"
    if isinstance(one, RateAlarm):
        text = f"{value} over {one.window_h:g} h, faster than {abs(limit):g} mm/d"
        what = f"fit to {judged.rows} rows up to {last}"
    else:
        side = "above" if limit == one.above_mm else "below"
        text = f"{value}, {side} {limit:+g} mm"
        what = f"median of {judged.rows} rows over {one.dwell_min:g} min up to {last}"
    suspect = sum(not row.is_good for row in found.rows[-judged.rows :])
    doubt = (
        f", {suspect} of them suspect (camera_bumped or calibration_drifting)" if suspect else ""
    )
    return (
        f"{text} by more than noise explains (sigma taken {one.sigmas:g} times; {what}{doubt}): "
        "look at the two images of the slot, then at the bridge; dcam-ctl alarm ack "
        f"{one.name} when you know"
    )
