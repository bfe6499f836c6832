"""How the displacement follows temperatures: so many mm per kelvin, so many hours later or before.

Of each reading either a pure shift, d(t) = c T(t - lag), which may be negative (the sun reaches the
deck before it warms the sensor), or a first-order lag, lag dF/dt = T - F, d = c F (steel and
concrete behind an air temperature); the one that explains more is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from core.analysis.binning import Hours
from core.analysis.noise import DAY_S, NoiseFit, gls
from core.analysis.readings import Lag, Reading, reading_of
from core.analysis.regression import (
    Fit,
    Interval,
    Mixture,
    by_blocks,
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
_UNSURE = 0.01
"""How wrong a reading behind its lag may be for its hour to be used, as a share of its usual change
within 12 hours. Chosen: of 10 K and 0.25 mm/K that is 0.025 mm, as much as good hours scatter."""
_SEARCHED = 6.0
"""First-order lag in hours whose past must be known where lags are sought."""
_LEAST_KNOWN = 0.5
"""Share of the hours for which a reading must be known to be used; so many are used at least."""
_ZOOMS = 4
"""How often the lags tried close in on the best."""
_ZOOMED = 9
"""Lags tried from the second time on."""
_STEP_H = 0.05
"""For derivatives by the lag."""
_ROUNDS = 2
"""Of lag and noise in turn; Gauss-Newton steps follow."""


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
    usable = _usable(hours, channels)
    if not usable:
        return None
    readings = [reading_of(hours, channel) for channel in usable]
    known = _known(readings, hours.times_s, [(Lag.FIRST_ORDER, _SEARCHED)] * len(usable))
    times_days = hours.times_s[known] / DAY_S
    line = _slow(times_days, None if beside is None else beside[known])
    values_mm = hours.mean_mm[known]
    lags = [(Lag.SHIFT, 0.0)] * len(usable)
    fit: Fit | None = None
    for _ in range(_ROUNDS):
        columns = _columns(readings, hours.times_s[known], lags)
        fit = robust_fit(times_days, np.column_stack([line, columns]), values_mm)
        before = lags
        lags = _better_lags(fit, readings, hours.times_s[known], columns, lags)
        if all(a[0] is b[0] and abs(a[1] - b[1]) < 0.02 for a, b in zip(before, lags, strict=True)):
            break
    known = _known(readings, hours.times_s, lags)
    line = _slow(hours.times_s[known] / DAY_S, None if beside is None else beside[known])
    return _judged(hours, known, line, usable, readings, lags, confidence)


def _slow(times_days: FloatArray, beside: FloatArray | None) -> FloatArray:
    """(n, p) what lies under the response: a slowly bending line, and columns beside it."""
    line = hinges(times_days, BEND_DAYS)
    return line if beside is None else independent(np.column_stack([line, beside]))


def _usable(hours: Hours, channels: tuple[int, ...]) -> list[int]:
    """Those channels that are known in half of the record and change."""
    usable = []
    for channel in channels:
        there = np.isfinite(hours.readings[:, channel])
        if there.mean() >= _LEAST_KNOWN and np.ptp(hours.readings[there, channel]) > 0.0:
            usable.append(channel)
    return usable


def _known(
    readings: list[Reading], times_s: FloatArray, lags: list[tuple[Lag, float]]
) -> BoolArray:
    """(n,) hours for which all readings behind their lags are known well enough.

    What happened in a gap, or before the record, is forgotten only some lags later. Half of the
    hours stay, the best known, where gaps are many or the lag is long.
    """
    unsure = np.max(
        [one.unsure(times_s, *lag) for one, lag in zip(readings, lags, strict=True)], axis=0
    )
    found: BoolArray = unsure <= max(_UNSURE, float(np.quantile(unsure, _LEAST_KNOWN)))
    return found


def _columns(
    readings: list[Reading], times_s: FloatArray, lags: list[tuple[Lag, float]]
) -> FloatArray:
    return np.column_stack(
        [reading.after(times_s, *lag) for reading, lag in zip(readings, lags, strict=True)]
    )


def _better_lags(
    fit: Fit,
    readings: list[Reading],
    times_s: FloatArray,
    columns: FloatArray,
    lags: list[tuple[Lag, float]],
) -> list[tuple[Lag, float]]:
    """The lag of each reading in turn that explains most beside the others."""
    lags = list(lags)
    for number, reading in enumerate(readings):
        others = _without(fit, columns.shape[1], number)
        best: dict[Lag, tuple[float, float]] = {}
        for kind, tried_h in ((Lag.SHIFT, _SHIFTS_H), (Lag.FIRST_ORDER, _LAGS_H)):
            best[kind] = _closed_in(kind, tried_h, reading, times_s[fit.keep], others)
        kind = max(best, key=lambda kind: best[kind][1])
        lags[number] = kind, best[kind][0]
    return lags


def _closed_in(
    kind: Lag, tried_h: FloatArray, reading: Reading, times_s: FloatArray, others: NoiseFit
) -> tuple[float, float]:
    """The lag of a kind that explains most, and how much.

    Of a year the peak is some seconds wide: two kinds are compared each at its own.
    """
    for _ in range(_ZOOMS):
        tried = np.column_stack([reading.after(times_s, kind, lag_h) for lag_h in tried_h])
        size, information = try_columns(others.whitening, others.gls, tried)
        lag_h, gain = _peak(tried_h, size**2 * information)
        best = int(np.argmax(size**2 * information))
        low, high = tried_h[max(best - 1, 0)], tried_h[min(best + 1, len(tried_h) - 1)]
        tried_h = np.linspace(low, high, _ZOOMED)
    return lag_h, gain


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
    readings: list[Reading],
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
    design = np.column_stack(
        [line, _columns(readings, times_s, lags), _by_lag(readings, times_s, lags) * sizes]
    )
    keep, p = fit.keep, design.shape[1]
    better = gls(fit.noise_fit.whitening, design[keep], values_mm[keep])
    fit = replace(fit, noise_fit=replace(fit.noise_fit, gls=better))
    mixture = Mixture.of(fit.noise_fit, times_days[keep], design[keep], values_mm[keep])
    responses = []
    for number, (channel, (kind, lag_h)) in enumerate(zip(usable, lags, strict=True)):
        left, size = (
            _wider(
                mixture.interval(unit, confidence),
                by_blocks(times_days[keep], design[keep], better, unit, confidence),
            )
            for unit in np.eye(p)[[p - count + number, p - 2 * count + number]]
        )
        lag = Interval(lag_h + left.value, left.sigma, lag_h + left.low, lag_h + left.high)
        responses.append(Response(channel, kind, lag, size))  # `left` is that of the last step
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


def _wider(by_noise: Interval, between_blocks: Interval | None) -> Interval:
    """The interval after the noise, or as wide as stretches of the record differ if that is more.

    Where the bridge follows a reading otherwise than either kind of lag does, stretches of other
    weather give other figures; the noise alone does not show that.
    """
    if between_blocks is None or between_blocks.sigma <= by_noise.sigma:
        return by_noise
    moved = by_noise.value - between_blocks.value
    low, high = between_blocks.low + moved, between_blocks.high + moved
    return Interval(by_noise.value, between_blocks.sigma, low, high)


def _allowed(kind: Lag, lag_h: float) -> float:
    return max(lag_h, float(_LAGS_H[0])) if kind is Lag.FIRST_ORDER else lag_h


def _by_lag(
    readings: list[Reading], times_s: FloatArray, lags: list[tuple[Lag, float]]
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
