"""What a study says, in lines for people."""

from __future__ import annotations

from collections.abc import Iterator

from core.analysis.creep import Creep
from core.analysis.readings import Lag
from core.analysis.regression import Interval
from core.analysis.steps import DRIFT_THRESHOLD, THRESHOLD, Drift, Steps
from core.analysis.thermal import Thermal
from core.analysis.trend import Trend
from daemon.analysis.fields import moment
from daemon.analysis.record import Channel
from daemon.analysis.study import Study
from daemon.text import utc_text


def sentences(study: Study, confidence: float) -> Iterator[str]:
    """What was excluded; a line for each thing found, with its interval; why a part is missing."""
    percent = f"{100.0 * confidence:g} %"
    if line := study.excluded.sentence():
        yield line
    if study.thermal:
        yield from _thermal(study.thermal, study.channels, percent)
    if study.trend:
        yield _trend(study.trend, percent)
    if study.drift:
        yield _drift(study.drift, percent)
    if study.steps:
        yield from _steps(study.steps, percent)
    for event, found in study.differences:
        yield (
            f"event {utc_text(event)}: level after less before {_mm(found.mm)} mm ({percent}), "
            f"plain means {found.raw_mm:+.3f} mm, {found.before} and {found.after} hours"
        )
    if study.creep:
        yield from _creep(study.creep)
    yield from study.notes


def _mm(interval: Interval) -> str:
    return f"{interval.value:+.3f} [{interval.low:+.3f}, {interval.high:+.3f}]"


def _thermal(thermal: Thermal, channels: tuple[Channel, ...], percent: str) -> Iterator[str]:
    for one in thermal.responses:
        channel = channels[one.channel]
        name = f"{channel.name}, slow part" if one.slow else channel.name
        unit = "K" if channel.unit == "degC" else channel.unit
        size = one.mm_per_unit
        lag = one.lag_h
        how = "behind it, first-order" if one.kind is Lag.FIRST_ORDER else "behind it"
        if one.kind is Lag.SHIFT and lag.value < 0.0:
            how = "behind it (negative: the displacement leads)"
        yield (
            f"{name}: {size.value:+.4f} [{size.low:+.4f}, {size.high:+.4f}] mm/{unit}, "
            f"{lag.value:.2f} [{lag.low:.2f}, {lag.high:.2f}] h {how} ({percent})"
        )
    yield (
        f"readings explain {100.0 * thermal.explained:.1f} % of the variance about a slow line; "
        f"{thermal.left_mm:.3f} mm (1 sigma of hourly means) is left"
    )


def _trend(trend: Trend, percent: str) -> str:
    season = "" if trend.seasonal else "; below 1.5 years it may be part of a season"
    return f"trend {_mm(trend.mm_per_year)} mm/year ({percent}){season}"


def _drift(drift: Drift, percent: str) -> str:
    word = "a drift" if drift.significant else "no drift that noise does not explain"
    return (
        f"last {drift.days:.0f} days: {_mm(drift.mm_per_year)} mm/year ({percent}), {word} "
        f"(score {abs(drift.score):.1f}, limit {DRIFT_THRESHOLD:g})"
    )


def _steps(steps: Steps, percent: str) -> Iterator[str]:
    for step in steps.steps:
        yield (
            f"step {_mm(step.mm)} mm ({percent}) between {utc_text(moment(step.first_s))} and "
            f"{utc_text(moment(step.last_s))} (score {abs(step.score):.1f})"
        )
    if not steps.steps:
        yield f"no step (highest score {steps.highest_score:.1f}, limit {THRESHOLD:g})"
    yield (
        f"a step of {steps.smallest_mm:.3f} mm is found in nine of ten cases, "
        f"within 24 hours one of {steps.smallest_in_a_day_mm:.3f} mm"
    )


def _creep(creep: Creep) -> Iterator[str]:
    best = min(one.aicc for one in creep.laws)
    for one in creep.laws:
        shape = ", ".join(f"{name} {value:.3g}" for name, value in one.shape.items())
        yield (
            f"creep, {one.law.value}: {sum(one.sizes_mm):+.3f} mm until now, {shape}, "
            f"AICc {one.aicc - best:+.1f}, probability {one.probability:.3f}"
        )
    by = f"some {100.0 * creep.departure:.0f} %" if creep.departure else "nothing that shows"
    yield f"creep: its rate departs from a law's by {by}; predictions allow for a departure"
    for prediction in creep.predictions:
        yield (
            f"creep, day {prediction.days:g} after loading: level {_mm(prediction.mm)} mm "
            "(90 %, over all laws)"
        )
