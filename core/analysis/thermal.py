"""How the displacement follows temperatures: so many mm per kelvin, so many hours later or before.

Of each reading either a pure shift, d(t) = c T(t - lag), which may be negative (the sun reaches the
deck before it warms the sensor), or a first-order lag, lag dF/dt = T - F, d = c F (steel and
concrete behind an air temperature); the one that explains more is taken. Beside it a second mass
behind a longer first-order lag, if that is there beyond doubt: a deck and its girder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from core.analysis.binning import Hours
from core.analysis.noise import DAY_S, NoiseFit, gls
from core.analysis.readings import Lag, Reading, Spans, known_share, reading_of
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
_USUALLY = 2.0
"""How many times as unsure as in the middle hour a reading may be in one that is used. Chosen."""
_ZOOMS = 4
"""How often the lags tried close in on the best."""
_ZOOMED = 9
"""Lags tried from the second time on."""
_SEARCHED_SLOW = 24.0
"""The same where slow masses are sought too."""
_SLOW_H = 4.0
"""First-order lag from which on a second mass is sought."""
_SLOWER = 3.0
"""And how many times that of the quick part. Chosen: nearer ones cannot be told apart."""
_CLEAR = 6.0
"""Standard deviations of its size from which on a part is there. Chosen: twenty lags are tried, in
records whose noise may be another than was fitted."""
_NEAR_H = 0.02
"""Change of a lag below which the search ends."""
_STEPS = 8
"""Of Gauss-Newton at most."""
_STILL_H = 1e-3
"""A step below which they end."""
_STEP_H = 0.05
"""For derivatives by the lag."""
_ROUNDS = 2
"""Of lags and noise in turn; Gauss-Newton steps follow."""


@dataclass(frozen=True, slots=True)
class Response:
    """What one reading does to the displacement."""

    channel: int
    """Column of the readings."""
    slow: bool
    """Of a second mass, beside the quick one of the same reading."""
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
    parts = [_Part(channel, reading_of(hours, channel), Lag.SHIFT, 0.0) for channel in usable]
    single, fit, spans = _sought(hours, parts, beside, _SEARCHED)
    both = single + _second_masses(single, fit, spans)
    if len(both) > len(single):
        both, *_ = _sought(hours, both, beside, _SEARCHED_SLOW)
        found = _judged(hours, both, beside, confidence)
        doubled = {part.channel for part in both[len(single) :]}
        if all(_clear(one) for one in found.responses if one.channel in doubled):
            return found
    return _judged(hours, single, beside, confidence)


@dataclass(frozen=True, slots=True)
class _Part:
    """A reading behind a lag."""

    channel: int
    reading: Reading
    kind: Lag
    lag_h: float

    def after(self, spans: Spans) -> FloatArray:
        """(n,) its means over the spans of hours."""
        return self.reading.after(spans, self.kind, self.lag_h)

    def moved(self, step_h: float) -> _Part:
        """The same behind another lag."""
        lag_h = self.lag_h + step_h
        first_order = self.kind is Lag.FIRST_ORDER
        return replace(self, lag_h=max(lag_h, float(_LAGS_H[0])) if first_order else lag_h)


def _sought(
    hours: Hours, parts: list[_Part], beside: FloatArray | None, past_h: float
) -> tuple[list[_Part], Fit, Spans]:
    """The parts behind their best lags, the last fit, and its hours.

    Of hours for which the readings `past_h` ago are known.
    """
    spans = Spans.of(hours)
    known = _known([replace(p, kind=Lag.FIRST_ORDER, lag_h=past_h) for p in parts], spans)
    spans, times_s, values_mm = spans.kept(known), hours.times_s[known], hours.mean_mm[known]
    line = _slow(times_s / DAY_S, None if beside is None else beside[known])
    for _ in range(_ROUNDS):
        columns = _columns(parts, spans)
        fit = robust_fit(times_s / DAY_S, np.column_stack([line, columns]), values_mm)
        before, parts = parts, _better_lags(fit, parts, spans.kept(fit.keep))
        if all(
            a.kind is b.kind and abs(a.lag_h - b.lag_h) < _NEAR_H
            for a, b in zip(before, parts, strict=True)
        ):
            break
    return parts, fit, spans.kept(fit.keep)


def _second_masses(parts: list[_Part], fit: Fit, spans: Spans) -> list[_Part]:
    """Slow parts of the same readings that explain more than chance would beside the quick ones."""
    found = []
    for part in parts:
        tried_h = _LAGS_H[max(_SLOW_H, _SLOWER * part.lag_h) <= _LAGS_H]
        if len(tried_h):
            lag_h, gain = _closed_in(Lag.FIRST_ORDER, tried_h, part.reading, spans, fit.noise_fit)
            if gain > _CLEAR**2:
                found.append(replace(part, kind=Lag.FIRST_ORDER, lag_h=lag_h))
    return found


def _clear(response: Response) -> bool:
    """Whether a size is one beyond doubt."""
    size = response.mm_per_unit
    return abs(size.value) > _CLEAR * size.sigma


def _slow(times_days: FloatArray, beside: FloatArray | None) -> FloatArray:
    """(n, p) what lies under the response: a slowly bending line, and columns beside it."""
    line = hinges(times_days, BEND_DAYS)
    return line if beside is None else independent(np.column_stack([line, beside]))


def _usable(hours: Hours, channels: tuple[int, ...]) -> list[int]:
    """Those channels that are known in half of the record and change."""
    usable = []
    for channel in channels:
        if known_share(hours, channel) < _LEAST_KNOWN:
            continue
        if np.nanmax(hours.readings[:, channel]) > np.nanmin(hours.readings[:, channel]):
            usable.append(channel)
    return usable


def _known(parts: list[_Part], spans: Spans) -> BoolArray:
    """(n,) hours for which all readings behind their lags are known well enough.

    What happened in a gap, or before the record, is forgotten only some lags later. Those that are
    known as well as most stay, where slots are few, gaps many or the lag long.
    """
    unsure = np.max([p.reading.unsure(spans, p.kind, p.lag_h) for p in parts], axis=0)
    usual = _USUALLY * float(np.quantile(unsure, _LEAST_KNOWN))
    found: BoolArray = unsure <= max(_UNSURE, usual)
    return found


def _columns(parts: list[_Part], spans: Spans) -> FloatArray:
    """(n, parts)."""
    return np.column_stack([part.after(spans) for part in parts])


def _better_lags(fit: Fit, parts: list[_Part], spans: Spans) -> list[_Part]:
    """The lag of each part in turn that explains most beside the others.

    The second part of a reading is a slow mass, the first one may also be a shift.
    """
    found: list[_Part] = []
    for number, part in enumerate(parts):
        others = _without(fit, len(parts), number)
        tried = {Lag.SHIFT: _SHIFTS_H, Lag.FIRST_ORDER: _LAGS_H}
        if any(part.channel == other.channel for other in found):
            tried = {Lag.FIRST_ORDER: _LAGS_H[_LAGS_H >= _SLOW_H]}
        best = {
            kind: _closed_in(kind, tried_h, part.reading, spans, others)
            for kind, tried_h in tried.items()
        }
        kind = max(best, key=lambda kind: best[kind][1])
        found.append(replace(part, kind=kind, lag_h=best[kind][0]))
    return found


def _closed_in(
    kind: Lag, tried_h: FloatArray, reading: Reading, spans: Spans, others: NoiseFit
) -> tuple[float, float]:
    """The lag of a kind that explains most, and how much.

    Of a year the peak is some seconds wide: two kinds are compared each at its own.
    """
    for _ in range(_ZOOMS):
        tried = np.column_stack([reading.after(spans, kind, lag_h) for lag_h in tried_h])
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
    hours: Hours, parts: list[_Part], beside: FloatArray | None, confidence: float
) -> Thermal:
    """The last Gauss-Newton steps, with the lags as unknowns among the others; and intervals."""
    everywhere = Spans.of(hours)
    known = _known(parts, everywhere)
    spans, times_s, values_mm = everywhere.kept(known), hours.times_s[known], hours.mean_mm[known]
    times_days = times_s / DAY_S
    line = _slow(times_days, None if beside is None else beside[known])
    columns = np.column_stack([line, _columns(parts, spans)])
    fit = robust_fit(times_days, columns, values_mm)
    keep, count = fit.keep, len(parts)
    sizes = fit.gls.coefficients[-count:]
    for _ in range(_STEPS):
        design = np.column_stack([line, _columns(parts, spans), _by_lag(parts, spans) * sizes])
        better = gls(fit.noise_fit.whitening, design[keep], values_mm[keep])
        sizes = better.coefficients[-2 * count : -count]
        steps_h = np.clip(better.coefficients[-count:], *_reach(parts))
        if (np.abs(steps_h) < _STILL_H).all():
            break
        parts = [part.moved(float(step_h)) for part, step_h in zip(parts, steps_h, strict=True)]
    mixture = Mixture.of(
        replace(fit.noise_fit, gls=better), times_days[keep], design[keep], values_mm[keep]
    )
    responses: list[Response] = []
    p = design.shape[1]
    for number, part in enumerate(parts):
        left, size = (
            _wider(
                mixture.interval(unit, confidence),
                by_blocks(times_days[keep], design[keep], better, unit, confidence),
            )
            for unit in np.eye(p)[[p - count + number, p - 2 * count + number]]
        )
        lag_h = part.lag_h  # `left` is that of a last step
        lag = Interval(lag_h + left.value, left.sigma, lag_h + left.low, lag_h + left.high)
        slow = any(part.channel == other.channel for other in responses)
        responses.append(Response(part.channel, slow, part.kind, lag, size))
    columns = _columns(parts, everywhere)
    columns[~known] = np.nan
    about = _about(values_mm, line)[keep]
    rest = _about(values_mm - _columns(parts, spans) @ sizes, line)[keep]
    explained = 1.0 - np.var(rest) / max(np.var(about), np.finfo(float).tiny)
    by_lag = _by_lag(parts, everywhere)
    return Thermal(tuple(responses), known, columns, by_lag, float(explained), float(np.std(rest)))


def _about(values_mm: FloatArray, line: FloatArray) -> FloatArray:
    """(n,) values less what a slow line explains of them."""
    found: FloatArray = values_mm - line @ np.linalg.lstsq(line, values_mm, rcond=None)[0]
    return found


def _reach(parts: list[_Part]) -> tuple[FloatArray, FloatArray]:
    """How far each lag may move in one step: a derivative holds only nearby."""
    high = np.array([0.25 + 0.25 * abs(part.lag_h) for part in parts])
    return -high, high


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


def _by_lag(parts: list[_Part], spans: Spans) -> FloatArray:
    """(n, parts) derivative by the lag, per hour."""
    found = []
    for part in parts:
        later, sooner = part.moved(_STEP_H), part.moved(-_STEP_H)
        change = later.after(spans) - sooner.after(spans)
        found.append(change / (later.lag_h - sooner.lag_h))
    return np.column_stack(found)
