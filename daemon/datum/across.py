"""The zero by rows on both sides of a calibration: the last before, and the first after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from core.arrays import FloatArray
from core.errors import digits
from core.results import Displacement
from daemon.datum.candidates import mean_gains
from daemon.datum.chain import weighted_mean
from daemon.datum.movement import movement_sigma_mm
from daemon.datum.seen import SeenRow
from daemon.store.records import DatumMethod, DatumStep
from daemon.text import span_text

WITHIN = timedelta(days=8)
"""How far from the calibration rows are looked at: a week, and what it lasts."""
_DAY_S = 86_400.0
_MOST_DAYS = 7
"""Rows at the same hour of other days are compared too: a bridge's daily movement then cancels."""
_NEAR_S = 900.0
"""By which pairs of rows may be less, or more, apart than the lag. Chosen: a daily wave of 5 mm
moves by 0.3 mm in that time, at most."""
_MOST_PAIRS = 24

Seen = Callable[[SeenRow], Displacement | None]
"""What a row says of one target."""


@dataclass(frozen=True, slots=True)
class Across:
    """The later reference from the earlier one."""

    step: DatumStep
    words: str
    """How it was found."""


def by_rows_across(
    before: Sequence[SeenRow], after: Sequence[SeenRow], earlier_id: int
) -> Across | None:
    """The bridge was, at the first rows after, where it was at rows before; None without any.

    Both in order; before by the earlier calibration, after by the later one. Of the lags between
    them, the shortest and whole days, that one counts over which the bridge moves least.
    """
    if not before or not after:
        return None
    lag_s, moving_mm = _quietest_lag(before, after)
    if moving_mm is None:
        return None
    pairs = _apart_by(before, after, lag_s)
    moving_mm2 = np.diag(moving_mm**2)
    main = _offset(pairs, lambda row: row.displacement, moving_mm2)
    assert main is not None  # noqa: S101 - every row has a displacement
    names = {name for row in before for name, _ in row.targets}
    found = {name: _offset(pairs, _of_target(name), moving_mm2) for name in sorted(names)}
    targets = {name: offset for name, offset in found.items() if offset is not None}
    words = (
        f"by {len(pairs)} pair{'s' if len(pairs) > 1 else ''} of rows before and after, "
        f"{span_text(lag_s)} apart; the bridge moves by {digits(moving_mm[0])}, "
        f"{digits(moving_mm[1])} mm in such a time"
    )
    earlier, later = (mean_gains([row.gains for row in side]) for side in zip(*pairs, strict=True))
    step = DatumStep(DatumMethod.ROWS, earlier_id, main, targets, later, earlier)
    return Across(step, words)


def _quietest_lag(
    before: Sequence[SeenRow], after: Sequence[SeenRow]
) -> tuple[float, FloatArray | None]:
    """The lag (s) over which the bridge moves least, and how far (2,), 1 sigma."""
    times_s = np.array([row.slot_utc.timestamp() for row in before])
    mm = np.array([row.displacement.mm for row in before])
    gap_s = (after[0].slot_utc - before[-1].slot_utc).total_seconds()
    lags_s = [gap_s, *(days * _DAY_S for days in range(1, _MOST_DAYS + 1))]
    lags_s = [lag_s for lag_s in lags_s if _apart_by(before, after, lag_s)]
    moving = [(lag_s, movement_sigma_mm(times_s, mm, lag_s)) for lag_s in lags_s]
    return min(moving, key=lambda one: np.inf if one[1] is None else float(np.hypot(*one[1])))


def _apart_by(
    before: Sequence[SeenRow], after: Sequence[SeenRow], lag_s: float
) -> list[tuple[SeenRow, SeenRow]]:
    """The first rows after, each with the row before that is nearest to the lag."""
    times_s = np.array([row.slot_utc.timestamp() for row in before])
    pairs = []
    for row in after:
        at = int(np.abs(row.slot_utc.timestamp() - lag_s - times_s).argmin())
        if abs(row.slot_utc.timestamp() - lag_s - times_s[at]) <= _NEAR_S:
            pairs.append((before[at], row))
        if len(pairs) == _MOST_PAIRS:
            break
    return pairs


def _offset(
    pairs: Sequence[tuple[SeenRow, SeenRow]], seen: Seen, moving_mm2: FloatArray
) -> Displacement | None:
    """The mean difference; the bridge's movement is much the same in all pairs of one lag."""
    both = [(seen(one), seen(other)) for one, other in pairs]
    differences = [_less(one, other) for one, other in both if one and other]
    if not differences:
        return None
    mean = weighted_mean(differences)
    return Displacement(mean.mm, mean.covariance_mm2 + moving_mm2)


def _less(one: Displacement, other: Displacement) -> Displacement:
    nothing = np.zeros((2, 2))
    shared = [nothing if d.shared_mm2 is None else d.shared_mm2 for d in (one, other)]
    return Displacement(
        one.mm - other.mm, one.covariance_mm2 + other.covariance_mm2, shared[0] + shared[1]
    )


def _of_target(name: str) -> Seen:
    return lambda row: dict(row.targets).get(name)


def replacing(steps: Sequence[DatumStep], better: DatumStep) -> tuple[DatumStep, ...]:
    """Steps with the answer by rows replaced: both rest on the same rows before.

    Targets that only the old answer knew are kept.
    """
    kept: list[DatumStep] = []
    known: Mapping[str, Displacement] = better.targets
    for step in steps:
        if step.method is not DatumMethod.ROWS or step.from_id != better.from_id:
            kept.append(step)
            continue
        left = {name: seen for name, seen in step.targets.items() if name not in known}
        if left:
            kept.append(DatumStep(step.method, step.from_id, None, left))
    return (*kept, better)
