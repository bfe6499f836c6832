"""A study as plain values: for `--json`, the page and the client's report."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

from core.analysis.creep import Creep
from core.analysis.noise import Noise
from core.analysis.regression import Interval
from core.analysis.steps import Drift, Steps
from core.analysis.thermal import Thermal
from core.analysis.trend import Difference, Trend
from daemon.analysis.days import Day
from daemon.analysis.record import Channel
from daemon.analysis.study import Study
from daemon.times import EPOCH


def study_fields(study: Study) -> dict[str, Any]:
    """All of a study; a part that there is none of is None, and `notes` says why."""
    return {
        "point": study.point,
        "axis": study.axis,
        "excluded": study.excluded.to_dict(),
        "days": [_day(day) for day in study.days],
        "hours": len(study.hours),
        "hours_used": int(study.used.sum()),
        "temperature": study.thermal and _thermal(study.thermal, study.channels),
        "trend": study.trend and _trend(study.trend),
        "steps": study.steps and _steps(study.steps),
        "drift": study.drift and _drift(study.drift),
        "creep": study.creep and _creep(study.creep),
        "before_after": [_difference(*found) for found in study.differences],
        "notes": list(study.notes),
    }


def moment(time_s: float) -> datetime:
    """A time of the numerics, to the second."""
    return EPOCH + timedelta(seconds=round(time_s))


def _interval(interval: Interval) -> dict[str, float]:
    return {
        "value": interval.value,
        "sigma": interval.sigma,
        "low": interval.low,
        "high": interval.high,
    }


def _day(day: Day) -> dict[str, Any]:
    return {
        "day": day.day.isoformat(),
        "min_mm": day.lowest_mm,
        "mean_mm": day.mean_mm,
        "max_mm": day.highest_mm,
        "rows": day.rows,
        "completeness": day.completeness,
    }


def _noise(noise: Noise) -> dict[str, Any]:
    return {
        "sigma_mm": noise.sigma_mm,
        "white_mm": noise.white_mm,
        "parts": [
            {"sigma_mm": part.sigma_mm, "memory_days": part.memory_days} for part in noise.parts
        ],
    }


def _thermal(thermal: Thermal, channels: tuple[Channel, ...]) -> dict[str, Any]:
    return {
        "explained": thermal.explained,
        "left_mm": thermal.left_mm,
        "readings": [
            {
                "name": channels[one.channel].name,
                "unit": channels[one.channel].unit,
                "kind": one.kind.value,
                "slow": one.slow,
                "lag_h": _interval(one.lag_h),
                "mm_per_unit": _interval(one.mm_per_unit),
            }
            for one in thermal.responses
        ],
    }


def _trend(trend: Trend) -> dict[str, Any]:
    return {
        "mm_per_year": _interval(trend.mm_per_year),
        "seasonal": trend.seasonal,
        "left_out": trend.left_out,
        "noise": _noise(trend.noise),
    }


def _steps(steps: Steps) -> dict[str, Any]:
    return {
        "found": [
            {
                "time_utc": moment(step.time_s),
                "earliest_utc": moment(step.first_s),
                "latest_utc": moment(step.last_s),
                "mm": _interval(step.mm),
                "score": step.score,
            }
            for step in steps.steps
        ],
        "highest_score_left": steps.highest_score,
        "smallest_mm": steps.smallest_mm,
        "smallest_in_a_day_mm": steps.smallest_in_a_day_mm,
        "noise": _noise(steps.noise),
    }


def _drift(drift: Drift) -> dict[str, Any]:
    return {
        "mm_per_year": _interval(drift.mm_per_year),
        "days": drift.days,
        "score": drift.score,
        "significant": drift.significant,
    }


def _creep(creep: Creep) -> dict[str, Any]:
    return {
        "values": creep.values,
        "sigma_mm": creep.sigma_mm,
        "departure": creep.departure,
        "laws": [
            {
                "law": one.law.value,
                "shape": one.shape,
                "sizes_mm": list(one.sizes_mm),
                "aicc": one.aicc,
                "probability": one.probability,
            }
            for one in creep.laws
        ],
        "predictions": [{"days": one.days, "mm": _interval(one.mm)} for one in creep.predictions],
    }


def _difference(event: datetime, found: Difference) -> dict[str, Any]:
    return {
        "event_utc": event,
        "mm": _interval(found.mm),
        "plain_mm": found.raw_mm,
        "hours_before": found.before,
        "hours_after": found.after,
        "noise": _noise(found.noise),
    }
