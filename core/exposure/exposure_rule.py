"""The law that exposure follows: from the light on a target now to how the next slot is exposed.

Everything is counted in the logarithm of the light gathered, exposure times gain. A step follows
only from a white outside the dead band, so that most slots change nothing; it is limited, so that
one odd frame costs little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from core.exposure.target_light import TargetLight

DEAD_BAND = math.log(1.28)
"""White may be that much brighter or darker than wanted before anything changes."""
MOST_STEP = math.log(4.0)
"""Of one slot, either way."""
SATURATED_SHARE = 0.25
"""With more of its white parts saturated, its brightness is not known: far down."""
CLIPPED = 0.98
"""White so near to full scale is taken as saturated: noise carries a part of it over."""
DARK, LIT, GLARING = 0.15, 0.3, 0.9
"""White of an area in which the target is not found: too dark to find it, again light enough, and
as bright as it may become on the way back to the start."""
PATIENCE_SLOTS = 10
"""So long a target that is not found leaves exposure where it is."""
_ALIKE = 0.01
"""Exposures that differ by less, as a logarithm, are the same: cameras set them in such steps."""
_DB = 20.0 / math.log(10.0)
"""Decibels of gain for each unit of the natural logarithm."""
_LEAST_WHITE = 1e-3
"""Of full scale: so that black does not give an infinite step."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """How one camera exposes."""

    time_us: float
    gain_db: float | None
    """None: the camera has no gain that could be set."""


@dataclass(frozen=True, slots=True)
class ExposureRule:
    """What the loop of one camera aims at, and within which limits."""

    start: Exposure
    least_us: float
    most_us: float
    least_db: float
    most_db: float
    white: float = 0.65
    """Wanted level of the target's white, as a share of the grey values' range."""


def next_exposure(
    now: Exposure, rule: ExposureRule, light: TargetLight, lost_slots: int = 0
) -> Exposure:
    """Give the exposure of the next slot; `now` itself where nothing is to change.

    lost_slots: for how many slots, this one included, the target was not found; `light` is then
    that of the area where it should be. Exposure is lengthened before gain is raised, and gain
    lowered before exposure is shortened: the least noise for the light there is.

    >>> now = Exposure(1000.0, 0.0)
    >>> rule = ExposureRule(now, least_us=20.0, most_us=2000.0, least_db=0.0, most_db=12.0)
    >>> next_exposure(now, rule, TargetLight(white=0.5, black=0.05, saturated=0.0))
    Exposure(time_us=1300.0, gain_db=0.0)
    >>> next_exposure(now, rule, TargetLight(white=0.6, black=0.05, saturated=0.0)) is now
    True
    """
    step = _lost_step(now, rule, light, lost_slots) if lost_slots else _step(rule, light)
    after = _split(_amount(now) + step, rule, has_gain=now.gain_db is not None)
    return now if abs(_amount(after) - _amount(now)) < _ALIKE else after


def within(rule: ExposureRule, exposure: Exposure) -> Exposure:
    """Give the same light by the rule's limits and order, or as near as they allow."""
    return _split(_amount(exposure), rule, has_gain=exposure.gain_db is not None)


def _step(rule: ExposureRule, light: TargetLight) -> float:
    """Bring the white of a target that was found to its level."""
    if light.saturated > SATURATED_SHARE or light.white >= CLIPPED:
        return -MOST_STEP
    step = math.log(rule.white / max(light.white, _LEAST_WHITE))
    return 0.0 if abs(step) < DEAD_BAND else _limited(step)


def _lost_step(now: Exposure, rule: ExposureRule, light: TargetLight, lost_slots: int) -> float:
    """Keep the area neither dark nor blown out; if that is not what hides the target, wait.

    When it stays hidden, exposure goes back to its start, as far as that keeps the area so: the
    target may come back in any light, and what stands in its place says nothing of it.
    """
    white = max(light.white, _LEAST_WHITE)
    if light.white >= CLIPPED:
        return -MOST_STEP
    if white < DARK:
        return _limited(math.log(LIT / white))
    if lost_slots <= PATIENCE_SLOTS:
        return 0.0
    start = _amount(
        within(
            rule, Exposure(rule.start.time_us, None if now.gain_db is None else rule.start.gain_db)
        )
    )
    back = _limited(start - _amount(now))
    back = max(back, math.log(LIT / white)) if back < 0.0 else min(back, math.log(GLARING / white))
    return 0.0 if abs(back) < DEAD_BAND or back * (start - _amount(now)) < 0.0 else back


def _limited(step: float) -> float:
    return max(-MOST_STEP, min(step, MOST_STEP))


def _amount(exposure: Exposure) -> float:
    return math.log(exposure.time_us) + (exposure.gain_db or 0.0) / _DB


def _split(amount: float, rule: ExposureRule, *, has_gain: bool) -> Exposure:
    """Share an amount of light out: as much exposure as there may be, the rest as gain."""
    least_db = rule.least_db if has_gain else 0.0
    time_us = math.exp(amount - least_db / _DB)
    time_us = round(max(rule.least_us, min(time_us, rule.most_us)), 1)
    if not has_gain:
        return Exposure(time_us, None)
    gain_db = (amount - math.log(time_us)) * _DB
    return Exposure(time_us, round(max(rule.least_db, min(gain_db, rule.most_db)), 2))
