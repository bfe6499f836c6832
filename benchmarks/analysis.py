"""Whether the analysis keeps its stated rates, on many simulated bridges; and what a year costs.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.analysis coverage creep steps other time

Hours of processor time for all; each study says its own figures as it ends.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from benchmarks.bridges import (
    BEGIN_S,
    CREEP_LAWS,
    CREEP_NOISES,
    DAY_S,
    OTHER_CREEP,
    Bridge,
    Made,
    creep_course,
    make,
    make_creep,
    write_record,
)
from benchmarks.other_bridges import make_other, some_other
from core.analysis.binning import Hours, hours_of
from core.analysis.creep import fit_creep
from core.analysis.steps import find_steps, recent_drift
from core.analysis.thermal import temperature_response
from core.analysis.trend import difference, trend_of
from core.arrays import FloatArray
from core.site import MAIN
from daemon.analysis.reading import analyse_store
from daemon.analysis.record import Channel, Record
from daemon.analysis.study import Asked, Study, study
from daemon.store.database import open_store_readonly
from daemon.store.ledger.exclusion import ExcludedRows

BRIDGE = Bridge()
DAILY_MM = "3 mm"
"""Of the simulated bridges' daily cycle: 0.25 mm/K, some 12 K in the sun."""


def prepared(made: Made) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, hourly means and what the temperature's response needs, as the command does it."""
    hours: Hours = hours_of(made.times_s, made.y_mm, made.deck_c[:, None])
    thermal = temperature_response(hours, (0,))
    if thermal is None:
        msg = "a simulated bridge has its readings"
        raise RuntimeError(msg)
    known = thermal.known
    warm = np.column_stack([thermal.columns, thermal.by_lag])[known]
    return hours.times_s[known], hours.mean_mm[known], warm


def some_bridge(seed: int) -> Bridge:
    """A bridge of 120 days with a step, of one of five kinds of response to its temperature.

    A shift; one mass; two masses; a shift and a mass; a shift beside a warmth of the sun that no
    sensor shows, which the model does not know.
    """
    rng = np.random.default_rng(1000 + seed)
    kind = seed % 5
    first_order = kind in {1, 2}
    bridge = replace(
        BRIDGE,
        days=120.0,
        lag_h=float(rng.uniform(1.0, 8.0) if first_order else rng.uniform(-2.0, 4.0)),
        first_order=first_order,
        trend_mm_per_year=float(rng.normal()),
        step_day=60.0,
        step_mm=float(rng.normal()),
    )
    if kind in {2, 3}:
        share = float(rng.uniform(0.2, 0.6))
        bridge = replace(bridge, slow_share=share, slow_h=float(rng.uniform(15.0, 40.0)))
        bridge = replace(bridge, lag_h=0.5 * bridge.lag_h)
    return replace(bridge, unseen_mm=0.1) if kind == 4 else bridge


def _masses(bridge: Bridge) -> list[tuple[float, float]]:
    """Lag in h and size in mm/K of each part of the response; none where they have no truth."""
    if bridge.unseen_mm:
        return []
    quick = bridge.lag_h, (1.0 - bridge.slow_share) * bridge.mm_per_kelvin
    slow = bridge.slow_h, bridge.slow_share * bridge.mm_per_kelvin
    return [quick, slow] if bridge.slow_share else [quick]


def study_coverage(count: int, first: int) -> Iterator[str]:
    """Lag, size, trend, difference: how often a 95 % interval holds the truth, by kind."""
    held: Counter[tuple[str, str]] = Counter()
    asked: Counter[tuple[str, str]] = Counter()
    otherwise = 0
    for seed in range(first, first + count):
        bridge = some_bridge(seed)
        made = make(bridge, 2000 + seed)
        hours = hours_of(made.times_s, made.y_mm, made.deck_c[:, None])
        event_s = BEGIN_S + 60.0 * DAY_S
        known_step = (hours.times_s >= event_s).astype(np.float64)[:, None]
        thermal = temperature_response(hours, (0,), beside=known_step)
        if thermal is None:
            continue
        known = thermal.known
        times_s, values_mm = hours.times_s[known], hours.mean_mm[known]
        warm = np.column_stack([thermal.columns, thermal.by_lag])[known]
        trend = trend_of(times_s, values_mm, np.column_stack([warm, known_step[known]])).mm_per_year
        near = np.abs(times_s - event_s) < 30.0 * DAY_S
        moved = difference(times_s[near], values_mm[near], event_s, warm[near]).mm
        after = times_s[near] >= event_s
        apart_s = times_s[near][after].mean() - times_s[near][~after].mean()
        drifted_mm = bridge.trend_mm_per_year * apart_s / DAY_S / 365.25
        judged = [
            ("trend", trend, bridge.trend_mm_per_year),
            ("before and after", moved, bridge.step_mm + drifted_mm),
        ]
        masses = _masses(bridge)
        otherwise += bool(masses) and len(masses) != len(thermal.responses)
        if len(masses) == len(thermal.responses):
            for response, (lag_h, size) in zip(thermal.responses, masses, strict=True):
                judged.append(("lag", response.lag_h, lag_h))
                judged.append(("mm per kelvin", response.mm_per_unit, size))
        kind = "unseen warmth" if not masses else ("one mass", "two masses")[len(masses) - 1]
        for name, interval, truth in judged:
            held[name, kind] += interval.low <= truth <= interval.high
            asked[name, kind] += 1
            if not interval.low <= truth <= interval.high:
                off = f"{(interval.value - truth) / interval.sigma:+.1f} sigma"
                yield f"bridge {seed}, {kind}: {name} {interval.value:.4f}, not {truth:.4f}, {off}"
        if (seed - first) % 5 == 4:
            yield f"{seed - first + 1} bridges: {held.total()} of {asked.total()} intervals hold"
    for key in sorted(asked):
        yield f"{key[0]}, {key[1]}: the 95 % interval holds {held[key]} of {asked[key]}"
    yield f"{otherwise} bridges have another number of masses than was found"


def study_creep(count: int, first: int) -> Iterator[str]:
    """Day 365 from 90 days: how often the 90 % interval holds the truth, by law and by noise."""
    held, widths, seconds = defaultdict[str, list[bool]](list), [], time.process_time()
    kinds = (*CREEP_LAWS, *OTHER_CREEP)
    for seed in range(first, first + count // len(kinds)):
        for number, kind in enumerate(kinds):
            noise = CREEP_NOISES[(seed + number) % len(CREEP_NOISES)]
            times_s, values_mm, truth = make_creep(kind, seed, noise)
            (found,) = fit_creep(times_s, values_mm, BEGIN_S, [365.0]).predictions
            fitted = "a law that is fitted" if kind in CREEP_LAWS else "one that is not"
            for name in (kind, f"noise {noise}", fitted, "all"):
                held[name].append(found.mm.low <= truth <= found.mm.high)
            widths.append(found.mm.high - found.mm.low)
    for name, truths in held.items():
        yield f"{name}: {sum(truths)} of {len(truths)}"
    each_s = (time.process_time() - seconds) / len(widths)
    yield f"median width {np.median(widths):.2f} mm, {each_s:.2f} s of processor time each"


def study_steps(count: int, first: int) -> Iterator[str]:
    """0.1 mm within 24 hours; 0.5 mm a year within 90 days; no drift where there is none."""
    found, sizes, drifts, wrong, held = 0, [], 0, 0, 0
    for seed in range(first, first + count):
        days = 60.0
        bridge = replace(BRIDGE, days=days, step_day=days - 1.0, step_mm=0.1)
        made = make(bridge, 3000 + seed)
        at_s = BEGIN_S + (days - 1.0) * DAY_S
        steps = [s for s in find_steps(*prepared(made)).steps if abs(s.time_s - at_s) < 0.5 * DAY_S]
        found += bool(steps)
        sizes += [step.mm.value for step in steps[:1]]
        held += any(step.mm.low <= 0.1 <= step.mm.high for step in steps)
        drifting = replace(BRIDGE, days=180.0, drift_day=90.0, drift_mm_per_year=0.5)
        drifts += recent_drift(*prepared(make(drifting, 4000 + seed))).significant
        quiet = replace(BRIDGE, days=180.0)
        wrong += recent_drift(*prepared(make(quiet, 5000 + seed))).significant
    yield f"0.1 mm within 24 hours: {found} of {count}, mean size {np.mean(sizes):.3f} mm"
    yield f"its 95 % interval holds 0.1 mm {held} times"
    yield f"0.5 mm a year, 90 days after it began: {drifts} of {count}; without: {wrong}"


def study_other(count: int, first: int) -> Iterator[str]:
    """Bridges of another make, 180 days: mm/K and lag; a drift of their last 90 days, and none."""
    held: Counter[tuple[str, str]] = Counter()
    asked: Counter[str] = Counter()
    for seed in range(first, first + count):
        bridge = some_other(seed)
        made = make_other(bridge, 88000 + seed)
        hours = hours_of(made.times_s, made.y_mm, made.deck_c[:, None])
        thermal = temperature_response(hours, (0,))
        if thermal is None or len(thermal.responses) != 1:
            yield f"bridge {seed}: no response to temperature, or two, where there is one"
            continue
        (response,) = thermal.responses
        known = thermal.known
        warm = np.column_stack([thermal.columns, thermal.by_lag])[known]
        times_s, quiet_mm = hours.times_s[known], hours.mean_mm[known]
        later_days = np.maximum((times_s - BEGIN_S) / DAY_S - 0.5 * bridge.days, 0.0)
        quiet = recent_drift(times_s, quiet_mm, warm)
        drifting = recent_drift(times_s, quiet_mm + 0.5 * later_days / 365.25, warm)
        truths = {
            "mm/K": (response.mm_per_unit, bridge.mm_per_kelvin),
            "lag": (response.lag_h, bridge.lag_h),
            "no drift": (quiet.mm_per_year, 0.0),
            "0.5 mm a year": (drifting.mm_per_year, 0.5),
        }
        for kind in (bridge.noise, f"rows of {bridge.every} minutes", "all"):
            asked[kind] += 1
            for name, (interval, truth) in truths.items():
                held[kind, f"{name} in its interval"] += interval.low <= truth <= interval.high
            held[kind, "found of 0.5 mm a year"] += drifting.significant
            held[kind, "false drifts"] += quiet.significant
    for kind, name in sorted(held):
        yield f"{kind}: {name} {held[kind, name]} of {asked[kind]}"


def study_creep_in_records(count: int, first: int) -> Iterator[str]:
    """Day 365 from 90 days of rows, by the whole analysis: temperature and steps beside creep."""
    kinds, held = (*CREEP_LAWS, *OTHER_CREEP), defaultdict[str, list[bool]](list)
    wrong, widths = 0, []
    for seed in range(first, first + count):
        kind, rng = kinds[seed % len(kinds)], np.random.default_rng(47000 + seed)
        made = make(replace(BRIDGE, days=90.0, every=10), 46000 + seed)
        at_days = np.arange(366 * 24) / 24.0
        course = creep_course(kind, rng, at_days, 90)
        found = _studied_since_loading(made, np.interp(_days_of(made), at_days, course))
        wrong += bool(found.steps and found.steps.steps)
        if found.creep is None:
            held[kind].append(False)
            yield f"bridge {seed}: no creep was fitted"
            continue
        (predicted,) = found.creep.predictions
        # At the mean temperature since loading.
        truth = course[365 * 24] + float(np.mean(made.y_mm))
        for name in (kind, "all"):
            held[name].append(predicted.mm.low <= truth <= predicted.mm.high)
        widths.append(predicted.mm.high - predicted.mm.low)
    for name, truths in held.items():
        yield f"{name}: {sum(truths)} of {len(truths)}"
    yield f"median width {np.median(widths):.2f} mm; a false step in {wrong} of {count}"


def study_quick_creep(count: int, first: int) -> Iterator[str]:
    """Creep that is partly over within hours or days of loading: what is taken for a step."""
    wrong = 0
    for seed in range(first, first + count):
        rng = np.random.default_rng(43000 + seed)
        made = make(replace(BRIDGE, days=90.0, every=10), 42000 + seed)
        days = _days_of(made)
        quick_days, share = np.exp(rng.uniform(np.log(0.08), np.log(4.0))), rng.uniform(0.3, 0.9)
        course = share * np.expm1(-days / quick_days) + (1.0 - share) * np.expm1(-days / 60.0)
        course *= rng.uniform(3.0, 15.0) * rng.choice([-1.0, 1.0]) / course[-1]
        found = _studied_since_loading(made, course)
        if found.steps and found.steps.steps:
            wrong += 1
            yield f"bridge {seed}: {len(found.steps.steps)} false steps, {quick_days:.2f} days"
    yield f"quick creep: a false step in {wrong} of {count}"


def _days_of(made: Made) -> FloatArray:
    return (made.times_s - BEGIN_S) / DAY_S


def _studied_since_loading(made: Made, creep_mm: FloatArray) -> Study:
    """What the whole analysis says of 90 days of rows every 10 minutes, with creep (n,) added."""
    loaded = datetime.fromtimestamp(BEGIN_S, UTC)
    record = Record(
        MAIN,
        made.times_s,
        np.column_stack([creep_mm, made.y_mm + creep_mm]),
        made.deck_c[:, None],
        (Channel("deck", "degC"),),
        ExcludedRows(),
    )
    return study(record, Asked(loaded=loaded), (loaded, loaded + timedelta(days=90.0)), 600.0)


def study_false_alarms(count: int, first: int) -> Iterator[str]:
    """Quiet years, analysed as a whole; and the last 60 days of them, every week."""
    whole, highest = 0, []
    for seed in range(first, first + count):
        prepared_year = prepared(make(BRIDGE, 6000 + seed))
        found = find_steps(*prepared_year)
        whole += len(found.steps)
        highest.append(found.highest_score)
        yield f"year {seed}: {len(found.steps)} steps, highest score {found.highest_score:.2f}"
    yield f"quiet years: {whole} false steps in {count}, highest score {max(highest):.2f}"


def study_weekly(count: int, first: int) -> Iterator[str]:
    """The last 60 days of quiet years, analysed every week as a service would."""
    alarms = 0
    for seed in range(first, first + count):
        made = make(BRIDGE, 7000 + seed)
        seen: list[float] = []
        for week in range(9, 53):
            end_s = BEGIN_S + 7.0 * week * DAY_S
            near = (made.times_s < end_s) & (made.times_s >= end_s - 60.0 * DAY_S)
            part = Made(made.times_s[near], made.y_mm[near], made.deck_c[near])
            for step in find_steps(*prepared(part)).steps:
                if all(abs(step.time_s - other) > DAY_S for other in seen):
                    seen.append(step.time_s)
        alarms += len(seen)
        yield f"year {seed}: {len(seen)} false steps in 44 weekly analyses"
    yield f"weekly analyses: {alarms} false steps in {count} years"


def study_time(count: int, first: int) -> Iterator[str]:
    """What reading and analysing a year of minutes takes."""
    for seed in range(first, first + count):
        made = make(replace(BRIDGE, lost=0.0, outages=0.0, step_day=200.0, step_mm=0.2), seed)
        with tempfile.TemporaryDirectory(prefix="dcam-bench-") as directory:
            write_record(Path(directory), made)
            with open_store_readonly(Path(directory)) as store:
                begin = time.process_time()
                analyse_store(store, None, None, Asked(zone=UTC), 60.0)
                yield f"{len(made.times_s)} rows: {time.process_time() - begin:.1f} s of CPU time"


STUDIES: dict[str, tuple[Callable[[int, int], Iterator[str]], int]] = {
    "coverage": (study_coverage, 100),
    "creep": (study_creep, 200),
    "steps": (study_steps, 50),
    "other": (study_other, 200),
    "creep-in-records": (study_creep_in_records, 200),
    "quick-creep": (study_quick_creep, 40),
    "false-alarms": (study_false_alarms, 30),
    "weekly": (study_weekly, 4),
    "time": (study_time, 1),
}
"""By name, with how many bridges."""


def main() -> None:
    """Run the studies named and print their figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.analysis", description=__doc__)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], default=list(STUDIES))
    parser.add_argument("--count", type=int, help="bridges, in place of the study's own number")
    parser.add_argument("--first", type=int, default=0, help="seed of the first: others are fresh")
    options = parser.parse_args()
    for name in options.studies:
        run, count = STUDIES[name]
        for line in run(options.count or count, options.first):
            print(f"{name}: {line}")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
