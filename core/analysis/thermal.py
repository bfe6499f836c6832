"""How the displacement follows temperatures: so many mm per kelvin, so many hours later or before.

Of each reading either a pure shift, d(t) = c T(t - lag), which may be negative (the sun reaches the
deck before it warms the sensor), or a first-order lag, lag dF/dt = T - F, d = c F (steel and
concrete behind an air temperature); the one that explains more is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.signal import lfilter

from core.analysis.binning import FINE_S, HOUR_S, Hours
from core.analysis.noise import DAY_S, NoiseFit, gls
from core.analysis.regression import (
    Fit,
    Interval,
    Mixture,
    hinges,
    independent,
    robust_fit,
    try_columns,
)
from core.arrays import BoolArray, FloatArray

BEND_DAYS = 60.0
"""The line under the temperature may bend at this distance: creep is not taken for warmth."""
_SHIFTS_H = np.arange(-8.0, 12.5, 0.5)
"""Shifts that are tried."""
_LAGS_H = np.geomspace(0.25, 96.0, 24)
"""First-order lags that are tried."""
_BRIDGED_H = 6.0
"""A gap in a reading up to which it is interpolated. Chosen: a quarter of the daily cycle."""
_SETTLING_H = 24.0
"""Hours of a reading, after its beginning and after a longer gap, that only fill the lag. Chosen:
of a lag of 10 h a tenth of what was before is left."""
_LEAST_KNOWN = 0.5
"""Share of the hours for which a reading must be known to be used."""
_WITHIN_S = (np.arange(6) - 2.5) * FINE_S
"""Where a reading is looked up within an hour."""
_START = 144
"""Values of the grid whose mean is what was before the first: a day."""
_STEP_H = 0.05
"""For derivatives by the lag."""
_ROUNDS = 2
"""Of lag and noise in turn; Gauss-Newton steps follow."""


class Lag(StrEnum):
    """How a displacement comes after a reading."""

    SHIFT = "shift"
    FIRST_ORDER = "first-order"


@dataclass(frozen=True, slots=True)
class Response:
    """What one reading does to the displacement."""

    channel: int
    """Column of the readings."""
    kind: Lag
    lag_h: Interval
    """Positive: the displacement follows."""
    mm_per_unit: Interval


@dataclass(frozen=True, slots=True)
class Thermal:
    """What readings do to the displacement."""

    responses: tuple[Response, ...]
    known: BoolArray
    """(hours,) where all of them are known."""
    columns: FloatArray
    """(hours, responses) the readings after their lags, less their means; NaN where not known."""
    by_lag: FloatArray
    """(hours, responses) derivative of each by its lag, 1/h."""
    explained: float
    """Share of the variance about the slow line that they explain."""
    left_mm: float
    """Standard deviation of what is left about it."""


@dataclass(frozen=True, slots=True)
class _Reading:
    """A reading on a regular grid, where it is known."""

    grid_s: FloatArray
    values: FloatArray

    def after(self, times_s: FloatArray, kind: Lag, lag_h: float) -> FloatArray:
        """(n,) its means, behind a lag, over the hours about these times."""
        shift_s, lagged = lag_h * HOUR_S, self.values
        if kind is Lag.FIRST_ORDER:
            shift_s, step = 0.0, FINE_S / HOUR_S / lag_h
            left = np.exp(-step)  # exact for lines from one value of the grid to the next
            now = 1.0 - (1.0 - left) / step
            start = float(np.mean(self.values[:_START]))
            weights = [now, 1.0 - left - now], [1.0, -left]
            lagged = lfilter(*weights, self.values - start) + start
        means = np.zeros(len(times_s))
        for offset_s in _WITHIN_S:
            means += np.interp(times_s + offset_s - shift_s, self.grid_s, lagged)
        return means / len(_WITHIN_S)


def temperature_response(
    hours: Hours,
    channels: tuple[int, ...],
    confidence: float = 0.95,
    beside: FloatArray | None = None,
) -> Thermal | None:
    """Lag and size of the displacement's response to readings; None if none of them is known.

    Columns `beside` (hours, k), such as known steps, are fitted with them.
    A reading that is known in less than half of the hours, or never changes, is passed over.
    """
    usable, known = _usable(hours, channels)
    if not usable:
        return None
    times_days = hours.times_s[known] / DAY_S
    line = _slow(times_days, None if beside is None else beside[known])
    values_mm = hours.mean_mm[known]
    readings = [_reading(hours, channel) for channel in usable]
    lags = [(Lag.SHIFT, 0.0)] * len(usable)
    fit: Fit | None = None
    for _ in range(_ROUNDS):
        columns = _columns(readings, hours.times_s[known], lags)
        fit = robust_fit(times_days, np.column_stack([line, columns]), values_mm)
        before = lags
        lags = _better_lags(fit, readings, hours.times_s[known], columns, lags)
        if all(a[0] is b[0] and abs(a[1] - b[1]) < 0.02 for a, b in zip(before, lags, strict=True)):
            break
    return _judged(hours, known, line, usable, readings, lags, confidence)


def _slow(times_days: FloatArray, beside: FloatArray | None) -> FloatArray:
    """(n, p) what lies under the response: a slowly bending line, and columns beside it."""
    line = hinges(times_days, BEND_DAYS)
    return line if beside is None else independent(np.column_stack([line, beside]))


def _usable(hours: Hours, channels: tuple[int, ...]) -> tuple[list[int], BoolArray]:
    known = np.ones(len(hours), dtype=np.bool_)
    usable = []
    for channel in channels:
        there = np.isfinite(hours.readings[:, channel])
        if there.mean() < _LEAST_KNOWN or np.ptp(hours.readings[there, channel]) == 0.0:
            continue
        usable.append(channel)
        places = hours.fine_s[there]
        begins = places[np.flatnonzero(np.diff(places, prepend=-np.inf) > _BRIDGED_H * HOUR_S)]
        ends = places[np.flatnonzero(np.diff(places, append=np.inf) > _BRIDGED_H * HOUR_S)]
        stretch = np.searchsorted(begins, hours.times_s + 0.5 * HOUR_S, side="right") - 1
        settled_s = begins[stretch] + _SETTLING_H * HOUR_S
        known &= (stretch >= 0) & (hours.times_s <= ends[stretch] + HOUR_S)
        known &= hours.times_s >= settled_s
    return usable, known


def _reading(hours: Hours, channel: int) -> _Reading:
    there = np.isfinite(hours.readings[:, channel])
    values = np.interp(hours.fine_s, hours.fine_s[there], hours.readings[there, channel])
    return _Reading(hours.fine_s, values - float(np.mean(values)))


def _columns(
    readings: list[_Reading], times_s: FloatArray, lags: list[tuple[Lag, float]]
) -> FloatArray:
    return np.column_stack(
        [reading.after(times_s, *lag) for reading, lag in zip(readings, lags, strict=True)]
    )


def _better_lags(
    fit: Fit,
    readings: list[_Reading],
    times_s: FloatArray,
    columns: FloatArray,
    lags: list[tuple[Lag, float]],
) -> list[tuple[Lag, float]]:
    """The lag of each reading in turn that explains most beside the others."""
    lags = list(lags)
    for number, reading in enumerate(readings):
        others = _without(fit, columns.shape[1], number)
        best: tuple[float, Lag, float] | None = None
        for kind, tried_h in ((Lag.SHIFT, _SHIFTS_H), (Lag.FIRST_ORDER, _LAGS_H)):
            tried = np.column_stack([reading.after(times_s[fit.keep], kind, h) for h in tried_h])
            size, information = try_columns(others.whitening, others.gls, tried)
            lag_h, gain = _peak(tried_h, size**2 * information)
            if best is None or gain > best[0]:
                best = gain, kind, lag_h
        if best is not None:
            lags[number] = best[1], best[2]
    return lags


def _without(fit: Fit, columns: int, number: int) -> NoiseFit:
    """The fit with the same noise without one of the readings, which stand last in the design."""
    solved = fit.noise_fit
    p = len(fit.gls.coefficients)
    left = [k for k in range(p) if k != p - columns + number]
    # From the normal equations: leaving a column out is a conditional of the fit.
    design_weighted = fit.gls.weighted_design
    normal = np.linalg.inv(fit.gls.covariance)
    covariance = np.linalg.inv(normal[np.ix_(left, left)])
    gone = p - columns + number
    change = covariance @ normal[left, gone] * fit.gls.coefficients[gone]
    coefficients = fit.gls.coefficients[left] + change
    column_whitened = design_weighted[:, gone] * fit.gls.coefficients[gone]
    whitened = fit.gls.whitened + column_whitened - design_weighted[:, left] @ change
    reduced = replace(
        fit.gls,
        coefficients=coefficients,
        covariance=covariance,
        whitened=whitened,
        weighted_design=design_weighted[:, left],
    )
    return replace(solved, gls=reduced)


def _peak(places: FloatArray, gains: FloatArray) -> tuple[float, float]:
    """Where a curve through the three highest points is highest, and how high."""
    best = int(np.argmax(gains))
    if best in {0, len(places) - 1}:
        return float(places[best]), float(gains[best])
    a, b, c = np.polyfit(places[best - 1 : best + 2], gains[best - 1 : best + 2], 2)
    place = float(np.clip(-0.5 * b / a, places[best - 1], places[best + 1]))
    return place, float(np.polyval((a, b, c), place))


def _judged(
    hours: Hours,
    known: BoolArray,
    line: FloatArray,
    usable: list[int],
    readings: list[_Reading],
    lags: list[tuple[Lag, float]],
    confidence: float,
) -> Thermal:
    """The last Gauss-Newton steps, with the lags as unknowns among the others."""
    times_s = hours.times_s[known]
    times_days, values_mm = times_s / DAY_S, hours.mean_mm[known]
    count = len(usable)
    fit = robust_fit(
        times_days, np.column_stack([line, _columns(readings, times_s, lags)]), values_mm
    )
    sizes = fit.gls.coefficients[-count:]
    for _ in range(2):
        columns = _columns(readings, times_s, lags)
        by_lag = _by_lag(readings, times_s, lags)
        design = np.column_stack([line, columns, by_lag * sizes])[fit.keep]
        better = gls(fit.noise_fit.whitening, design, values_mm[fit.keep])
        sizes = better.coefficients[-2 * count : -count]
        steps = np.clip(better.coefficients[-count:], -2.0, 2.0)
        lags = [
            (kind, _allowed(kind, lag_h + float(step)))
            for (kind, lag_h), step in zip(lags, steps, strict=True)
        ]
    fit = replace(fit, noise_fit=replace(fit.noise_fit, gls=better))
    design = np.column_stack(
        [line, _columns(readings, times_s, lags), _by_lag(readings, times_s, lags) * sizes]
    )
    keep, p = fit.keep, design.shape[1]
    mixture = Mixture.of(fit.noise_fit, times_days[keep], design[keep], values_mm[keep])
    responses = []
    for number, (channel, (kind, lag_h)) in enumerate(zip(usable, lags, strict=True)):
        unit = np.eye(p)[[p - count + number, p - 2 * count + number]]
        left = mixture.interval(unit[0], confidence)  # of the last step
        lag = Interval(lag_h + left.value, left.sigma, lag_h + left.low, lag_h + left.high)
        responses.append(Response(channel, kind, lag, mixture.interval(unit[1], confidence)))
    everywhere = _columns(readings, hours.times_s, lags)
    everywhere[~known] = np.nan
    sizes = np.array([response.mm_per_unit.value for response in responses])
    about = values_mm - line @ np.linalg.lstsq(line, values_mm, rcond=None)[0]
    rest = values_mm - _columns(readings, times_s, lags) @ sizes
    rest = (rest - line @ np.linalg.lstsq(line, rest, rcond=None)[0])[fit.keep]
    return Thermal(
        tuple(responses),
        known,
        everywhere,
        _by_lag(readings, hours.times_s, lags),
        float(1.0 - np.var(rest) / max(np.var(about[fit.keep]), np.finfo(float).tiny)),
        float(np.std(rest)),
    )


def _allowed(kind: Lag, lag_h: float) -> float:
    return max(lag_h, float(_LAGS_H[0])) if kind is Lag.FIRST_ORDER else lag_h


def _by_lag(
    readings: list[_Reading], times_s: FloatArray, lags: list[tuple[Lag, float]]
) -> FloatArray:
    """(n, readings) derivative by the lag, per hour."""
    later = [(kind, lag_h + _STEP_H) for kind, lag_h in lags]
    sooner = [
        (kind, max(lag_h - _STEP_H, 0.01) if kind is Lag.FIRST_ORDER else lag_h - _STEP_H)
        for kind, lag_h in lags
    ]
    span = np.array([b[1] - a[1] for a, b in zip(sooner, later, strict=True)])
    found: FloatArray = (
        _columns(readings, times_s, later) - _columns(readings, times_s, sooner)
    ) / span
    return found
