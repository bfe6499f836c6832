"""All that the analysis says of one axis of one point, each part or why there is none of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime, tzinfo

import numpy as np

from core.analysis.binning import Hours, hours_of
from core.analysis.creep import Creep, fit_creep
from core.analysis.noise import DAY_S
from core.analysis.steps import Drift, Steps, find_steps, recent_drift
from core.analysis.thermal import Thermal, temperature_response
from core.analysis.trend import Difference, Trend, difference, trend_of
from core.arrays import BoolArray, FloatArray
from core.site import MAIN
from daemon.analysis.days import Day, days_of
from daemon.analysis.record import Channel, Record
from daemon.store.ledger.exclusion import ExcludedRows

LEAST_DAYS = 5.0
"""Days with hourly means below which nothing but the days' figures is given."""
LEAST_DRIFT_DAYS = 30.0
"""As LEAST_DAYS, for the slope of the last months."""
EVENT_DAYS = 30.0
"""What is looked at on either side of an event."""
_NEAR_EVENT_DAYS = 3.0
"""A step found so near an event is the event's."""
_SETTLING_DAYS = 0.1 * 2.0 ** np.arange(11)
"""Time constants, from hours to a season, of the creep since loading that is regressed out where
temperature and steps are looked for: any creep is a sum of such parts, and its quick ones are no
steps."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What is asked of a record."""

    point: str = MAIN
    axis: str = "y"
    """Or x."""
    readings: tuple[str, ...] = ()
    """To regress out; none: those in degC."""
    zone: tzinfo = UTC
    """In which days begin."""
    events: tuple[datetime, ...] = ()
    """Before and after which the level is compared."""
    loaded: datetime | None = None
    """From when on creep is fitted; None: no creep."""
    predict_days: tuple[float, ...] = (365.0,)
    """After loading."""
    confidence: float = 0.95
    """Of all intervals but that of a prediction of creep, which is 90 %."""
    with_excluded: bool = False
    """Whether what the quality ledger excludes is taken in."""


@dataclass(frozen=True, slots=True)
class Study:
    """What one axis of one point says."""

    point: str
    axis: str
    days: tuple[Day, ...]
    channels: tuple[Channel, ...]
    hours: Hours
    used: BoolArray
    """(hours,) those with all readings known, of which everything below is made."""
    excluded: ExcludedRows
    thermal: Thermal | None = None
    trend: Trend | None = None
    steps: Steps | None = None
    drift: Drift | None = None
    creep: Creep | None = None
    differences: tuple[tuple[datetime, Difference], ...] = ()
    notes: tuple[str, ...] = field(default=())
    """Why a part is not there."""


def study(record: Record, asked: Asked, span: tuple[datetime, datetime], period_s: float) -> Study:
    """Analyse one axis of the rows of a span, of which there should be one each `period_s`."""
    values_mm = record.values_mm[:, "xy".index(asked.axis)]
    days = days_of(record.times_s, values_mm, asked.zone, period_s, span)
    hours = hours_of(record.times_s, values_mm, record.readings)
    whole = np.ones(len(hours), dtype=np.bool_)
    known_days = _days(hours.times_s)
    if known_days < LEAST_DAYS:
        note = (
            f"{known_days:.1f} days with enough good rows: temperature, trend, steps and creep "
            f"need {LEAST_DAYS:g}"
        )
        known = record.point, asked.axis, days, record.channels, hours, whole, record.excluded
        return Study(*known, notes=(note,))
    return _Analyst(record, asked, days, hours).study()


def _days(times_s: FloatArray) -> float:
    """How many days these hours span."""
    return float(times_s[-1] - times_s[0]) / DAY_S if len(times_s) > 1 else 0.0


class _Analyst:
    """Makes the parts of a study one after another: each is regressed out of those after it."""

    def __init__(self, record: Record, asked: Asked, days: tuple[Day, ...], hours: Hours) -> None:
        self._record, self._asked = record, asked
        self._days, self._hours = days, hours
        self._notes: list[str] = []
        self._used = np.ones(len(hours), dtype=np.bool_)
        self._warm = np.empty((len(hours), 0))

    def study(self) -> Study:
        """All parts."""
        confidence = self._asked.confidence
        thermal = self._thermal(np.empty((len(self._hours), 0)))
        steps = self._steps()
        if thermal and steps.steps:  # beside which the temperature is found better, and they by it
            at_s = np.array([step.time_s for step in steps.steps])
            thermal = self._thermal((self._hours.times_s[:, None] >= at_s).astype(np.float64))
            steps = self._steps()
        times_s, values_mm = self._hours.times_s[self._used], self._hours.mean_mm[self._used]
        warm = self._warm[self._used]
        beside = np.column_stack([warm, steps.columns])
        return Study(
            self._record.point,
            self._asked.axis,
            self._days,
            self._record.channels,
            self._hours,
            self._used,
            self._record.excluded,
            thermal,
            trend_of(times_s, values_mm, beside, confidence=confidence),
            steps,
            self._drift(times_s, values_mm, beside),
            self._creep(times_s, values_mm, warm, steps),
            self._differences(times_s, values_mm, warm, steps),
            tuple(self._notes),
        )

    def _steps(self) -> Steps:
        times_s, values_mm = self._hours.times_s[self._used], self._hours.mean_mm[self._used]
        beside = np.column_stack([self._warm[self._used], self._settling(times_s)])
        return find_steps(times_s, values_mm, beside, confidence=self._asked.confidence)

    def _thermal(self, beside: FloatArray) -> Thermal | None:
        names = [channel.name for channel in self._record.channels]
        under = np.column_stack([beside, self._settling(self._hours.times_s)])
        found = temperature_response(
            self._hours, tuple(range(len(names))), self._asked.confidence, under
        )
        if found is None:
            self._notes.append(f"temperature: {', '.join(names)}: no or constant readings")
            return None
        if _days(self._hours.times_s[found.known]) < LEAST_DAYS:
            self._notes.append(
                f"temperature: {', '.join(names)}: known for less than {LEAST_DAYS:g} days"
            )
            return None
        self._used = found.known
        self._warm = np.column_stack([found.columns, found.by_lag])
        return found

    def _settling(self, times_s: FloatArray) -> FloatArray:
        if self._asked.loaded is None:
            return np.empty((len(times_s), 0))
        since = np.maximum(times_s - self._asked.loaded.timestamp(), 0.0) / DAY_S
        found: FloatArray = -np.expm1(-since[:, None] / _SETTLING_DAYS)
        return found

    def _drift(
        self, times_s: FloatArray, values_mm: FloatArray, beside: FloatArray
    ) -> Drift | None:
        if _days(times_s) < LEAST_DRIFT_DAYS:
            self._notes.append(f"drift: needs {LEAST_DRIFT_DAYS:g} days")
            return None
        return recent_drift(times_s, values_mm, beside, confidence=self._asked.confidence)

    def _creep(
        self, times_s: FloatArray, values_mm: FloatArray, warm: FloatArray, steps: Steps
    ) -> Creep | None:
        loaded = self._asked.loaded
        if loaded is None:
            return None
        later = [
            number
            for number, step in enumerate(steps.steps)
            if step.time_s > loaded.timestamp() + DAY_S
        ]
        beside = np.column_stack([warm, steps.columns[:, later]])
        try:
            return fit_creep(
                times_s[steps.keep],
                values_mm[steps.keep],
                loaded.timestamp(),
                self._asked.predict_days,
                beside[steps.keep],
            )
        except ValueError as error:
            self._notes.append(f"creep: {error}")
            return None

    def _differences(
        self, times_s: FloatArray, values_mm: FloatArray, warm: FloatArray, steps: Steps
    ) -> tuple[tuple[datetime, Difference], ...]:
        found = []
        for event in self._asked.events:
            event_s = event.timestamp()
            near = np.abs(times_s - event_s) <= EVENT_DAYS * DAY_S
            others = [
                number
                for number, step in enumerate(steps.steps)
                if abs(step.time_s - event_s) > _NEAR_EVENT_DAYS * DAY_S
            ]
            beside = np.column_stack([warm, steps.columns[:, others]])[near]
            try:
                one = difference(
                    times_s[near],
                    values_mm[near],
                    event_s,
                    beside,
                    confidence=self._asked.confidence,
                )
            except ValueError as error:
                self._notes.append(f"before and after: {error}")
                continue
            found.append((event, one))
        return tuple(found)
