"""Several frame pairs of one slot to one measurement: robust, with their scatter in its sigma.

Heat haze and vibration move the images by more than their own noise, and differently from pair to
pair. Their scatter shows it; their mean suffers from it less.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np
from scipy.special import stdtrit

from core.arrays import FloatArray
from core.quality.verdicts import flag_of
from core.results import (
    Diagnostics,
    Displacement,
    Flag,
    Measurement,
    Reason,
    RigMotion,
    TargetMeasurement,
)

Seen = TypeVar("Seen", Measurement, TargetMeasurement)

_HUBER = 2.0
"""Standard deviations of a two-dimensional normal distribution: one pair in seven is beyond."""
_ROUNDS = 20
"""Of Huber's weights (1964). Chosen: more than they need; with a few pairs it costs nothing."""
_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_ONE_SIGMA = 0.841345
"""Normal probability below +1 sigma."""


def combine(pairs: Sequence[Measurement]) -> Measurement:
    """Combine the measurements of one slot's pairs; one pair is given back as it is.

    At least half of the pairs good: their robust mean, good. Else, at least half with a value: the
    robust mean of all values, with the reasons of most. Else no value.

    >>> def pair(x_mm: float) -> Measurement:
    ...     value = Displacement(np.array([x_mm, 0.0]), 1e-4 * np.eye(2))
    ...     return Measurement(Flag.GOOD, (), value, value, None)
    >>> slot = combine([pair(1.00), pair(1.02), pair(0.98), pair(1.01), pair(3.00)])  # one shaken
    >>> slot.corrected.mm.round(2).tolist(), slot.frames_used
    ([1.01, 0.0], 5)
    """
    if len(pairs) == 1:
        return pairs[0]
    chosen, reasons = _verdict(pairs)
    used = [pair for pair in chosen if pair.corrected is not None]
    flag = flag_of(reasons, has_value=bool(used))
    targets = _combine_targets(used or pairs)
    closure = _mean([pair.closure for pair in used or pairs if pair.closure is not None])
    if not used:
        raw = _mean([pair.raw for pair in pairs if pair.raw is not None])
        motion = _mean_motion([pair.motion for pair in pairs if pair.motion is not None])
        seen = _typical(pairs)
        return Measurement(flag, reasons, None, raw, motion, seen, closure=closure, targets=targets)
    values = [pair.corrected for pair in used if pair.corrected is not None]
    weights = _weights(values)
    return Measurement(
        flag,
        reasons,
        _mean(values, weights),
        _mean([pair.raw for pair in used if pair.raw is not None], weights),
        _mean_motion([pair.motion for pair in used if pair.motion is not None], weights),
        _typical(used),
        _spread(values, weights) if len(values) > 1 else None,
        len(values),
        closure,
        targets,
    )


def _combine_targets(pairs: Sequence[Measurement]) -> tuple[TargetMeasurement, ...]:
    """The further targets, each by the pairs that speak for it."""
    return tuple(
        _combine_target(seen) for seen in zip(*(pair.targets for pair in pairs), strict=False)
    )


def _combine_target(seen: Sequence[TargetMeasurement]) -> TargetMeasurement:
    chosen, reasons = _verdict(seen)
    values = [one.corrected for one in chosen if one.corrected is not None]
    raws = [one.raw for one in chosen if one.raw is not None]
    return replace(
        seen[0],
        flag=flag_of(reasons, has_value=bool(values)),
        reasons=reasons,
        corrected=_mean(values, _weights(values) if len(values) > 1 else None),
        raw=_mean(raws),
        taken_off=_mean_taken_off([one.taken_off for one in chosen]),
    )


def _mean_taken_off(
    taken_off: Sequence[Mapping[str, FloatArray] | None],
) -> dict[str, FloatArray] | None:
    """The mean; nothing was taken off a target that a pair does not name."""
    known = [one for one in taken_off if one is not None]
    if len(known) < len(taken_off):
        return None
    names = dict.fromkeys(name for one in known for name in one)
    return {
        name: np.sum([one[name] for one in known if name in one], axis=0) / len(known)
        for name in names
    }


def _verdict(pairs: Sequence[Seen]) -> tuple[Sequence[Seen], tuple[Reason, ...]]:
    """Which pairs speak for the slot, and the reasons why it is not good."""
    good = [pair for pair in pairs if pair.flag is Flag.GOOD]
    if 2 * len(good) >= len(pairs):
        return good, ()
    valued = [pair for pair in pairs if pair.corrected is not None]
    if 2 * len(valued) >= len(pairs):
        return valued, _reasons_of_most(valued)
    without = [pair for pair in pairs if pair.corrected is None]
    return without, _reasons_of_most(without)


def _reasons_of_most(pairs: Sequence[Seen]) -> tuple[Reason, ...]:
    """The reasons that more than half of the pairs give; else those given most often."""
    counts = Counter(reason for pair in pairs for reason in pair.reasons)
    enough = min(len(pairs) / 2.0 + 0.5, max(counts.values()))
    return tuple(reason for reason, count in counts.items() if count >= enough)


def _weights(values: Sequence[Displacement]) -> FloatArray:
    """Huber's weights (n,) about the robust mean: 1 near it, less for a pair far away."""
    mm = np.array([value.mm for value in values])
    noise_mm2 = np.mean([np.diag(_own(value)) for value in values], axis=0)
    middle = np.median(mm, axis=0)
    scale = np.maximum(_MAD * np.median(np.abs(mm - middle), axis=0), np.sqrt(noise_mm2))
    weights: FloatArray = np.ones(len(mm))
    for _ in range(_ROUNDS):
        away = np.hypot(*((mm - middle) / scale).T)
        weights = np.minimum(1.0, _HUBER / np.maximum(away, 1e-12))
        middle = weights @ mm / weights.sum()
    return weights


def _own(value: Displacement) -> FloatArray:
    """Covariance (2, 2) of this frame alone: what an average makes less."""
    return value.covariance_mm2 - (0.0 if value.shared_mm2 is None else value.shared_mm2)


def _spread(values: Sequence[Displacement], weights: FloatArray) -> FloatArray:
    """(2,) 1 sigma of one pair about the mean, mm."""
    mm = np.array([value.mm for value in values])
    squares = weights @ (mm - weights @ mm / weights.sum()) ** 2 / weights.sum()
    return np.asarray(np.sqrt(squares * len(mm) / (len(mm) - 1.0)))


def _mean(values: Sequence[Displacement], weights: FloatArray | None = None) -> Displacement | None:
    """Weighted mean: the frames' own noise averages, what they share does not.

    The noise of one frame is what its image says, or what the values' spread says if that is more,
    widened as Student's t asks of so few values.
    """
    if not values:
        return None
    w = np.ones(len(values)) if weights is None else weights
    mm = w @ np.array([value.mm for value in values]) / w.sum()
    own = np.mean([_own(value) for value in values], axis=0)
    whole = np.mean([value.covariance_mm2 for value in values], axis=0)
    images = [value.by_image_mm2 for value in values]
    shared, calibration = whole - own, np.mean(images, axis=0) - own
    if len(values) > 1:
        seen = stdtrit(len(values) - 1.0, _ONE_SIGMA) * _spread(values, w)
        wider = np.maximum(1.0, seen / np.sqrt(np.maximum(np.diag(own), 1e-18)))
        own = own * np.outer(wider, wider) / w.sum()
    return Displacement(mm, own + shared, shared, own + calibration)


def _mean_motion(
    motions: Sequence[RigMotion], weights: FloatArray | None = None
) -> RigMotion | None:
    """Weighted mean of small motions."""
    if not motions:
        return None
    w = np.ones(len(motions)) if weights is None else weights
    share = w / w.sum()
    return RigMotion(
        share @ np.array([motion.rotation_rad for motion in motions]),
        share @ np.array([motion.translation_mm for motion in motions]),
        np.mean([motion.covariance for motion in motions], axis=0) / w.sum(),
    )


def _typical(pairs: Sequence[Measurement]) -> Diagnostics:
    """Each figure's median over the pairs that have it."""
    medians: dict[str, float | int] = {}
    for name in (field.name for field in fields(Diagnostics)):
        figures = [getattr(pair.diagnostics, name) for pair in pairs]
        known = [figure for figure in figures if figure is not None]
        if known:
            median = float(np.median(known))
            medians[name] = int(median) if isinstance(known[0], int) else median
    return Diagnostics(**medians)  # type: ignore[arg-type]
