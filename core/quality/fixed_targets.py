"""Whether a fixed target has moved by itself: by the rows before, and by what the others did.

From one row to the next the pair can change by little. A fixed target that jumps by more has moved,
or the cameras have been knocked against each other, or the board has slipped: then the main target
jumps with it. If it does not, the fixed target moved alone and is not believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.moment import Moment
from core.results import Displacement, Measurement, Reason, TargetMeasurement
from core.rig.calibrated_site import CalibratedSite
from core.rig.stability import main_scale, stability_terms, state_effects, total_covariance
from core.site import Site, TargetRole

HISTORY_ROWS = 60
"""Rows that a new one is compared with: an hour of minutes. Chosen."""
LOST_ROWS = 5
"""A fixed target that was not believed in so many rows on end is not believed until the next
calibration. Chosen: haze and birds come and go within minutes."""
_BEYOND = 30.0
"""Squared step, in sigmas, that is no chance: of a normal distribution in two dimensions one row in
three million is beyond it."""
_ENOUGH_STEPS = 10
"""Steps from which on their own scatter counts."""
_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True, slots=True)
class PastRow:
    """A row before."""

    moment: Moment
    measurement: Measurement


def not_believed_any_more(rows: Sequence[PastRow]) -> frozenset[str]:
    """Fixed targets that the last rows (in order) did not believe, each time they saw them."""
    names = {target.name for row in rows for target in row.measurement.targets}
    return frozenset(name for name in names if _lost(rows, name))


def _lost(rows: Sequence[PastRow], name: str) -> bool:
    seen = [target for row in rows for target in row.measurement.targets if target.name == name]
    last = [target for target in seen if target.corrected is not None][-LOST_ROWS:]
    return len(last) == LOST_ROWS and all(_is_moved(target) for target in last)


def moved_alone(
    rows: Sequence[PastRow],
    now: Measurement,
    moment: Moment,
    site: Site,
    calibrated: CalibratedSite,
) -> frozenset[str]:
    """Fixed targets that have moved by themselves since the last row that believed them."""
    return frozenset(
        target.name
        for target in now.targets
        if target.role is TargetRole.FIXED
        and not _is_moved(target)
        and _moved_alone(rows, now, target, moment, site, calibrated)
    )


def _moved_alone(
    rows: Sequence[PastRow],
    now: Measurement,
    target: TargetMeasurement,
    moment: Moment,
    site: Site,
    calibrated: CalibratedSite,
) -> bool:
    past = [(row, seen) for row in rows if (seen := _seen(row.measurement, target.name))]
    main = _before_closure(now)
    if not past or target.corrected is None or main is None:
        return False
    last, before = past[-1]
    step_mm = target.corrected.mm - before.mm
    allowed_mm2 = target.corrected.by_image_mm2 + before.by_image_mm2
    allowed_mm2 += _budget_mm2(target.name, last.moment, moment, site, calibrated)
    allowed_mm2 += _scatter_mm2(np.array([seen.mm for _, seen in past]))
    if float(step_mm @ np.linalg.solve(allowed_mm2, step_mm)) < _BEYOND:
        return False
    main_before = _before_closure(last.measurement)
    if main_before is None:
        return False
    main_step_mm = main - main_before
    return float(np.hypot(*main_step_mm)) < float(np.hypot(*(main_step_mm - step_mm)))


def _is_moved(target: TargetMeasurement) -> bool:
    return Reason.FIXED_TARGET_MOVED in target.reasons


def _seen(measurement: Measurement, name: str) -> Displacement | None:
    """What a row that believed a fixed target said of it."""
    for target in measurement.targets:
        if target.name == name and not _is_moved(target) and measurement.corrected is not None:
            return target.corrected
    return None


def _before_closure(measurement: Measurement) -> FloatArray | None:
    """(2,) displacement of the main target by the rig's motion alone, mm."""
    corrected, closure = measurement.corrected, measurement.closure
    if corrected is None:
        return None
    return corrected.mm if closure is None else corrected.mm + closure.mm


def _budget_mm2(
    name: str, before: Moment, now: Moment, site: Site, calibrated: CalibratedSite
) -> FloatArray:
    """Covariance (2, 2) of a target's step by what the stability budget allows in the time."""
    target = next((one for one in calibrated.further if one.name == name), None)
    if target is None:
        return np.zeros((2, 2))
    terms = stability_terms(site, main_scale(calibrated.B), before, now, calibrated.lens)
    state = total_covariance(terms)
    centre_px, main_mm = site.main.centre_px, site.main_target.distance_mm
    effects = state_effects(target, target.middle_px, centre_px, main_mm)[:2]
    to_mm = np.linalg.inv(target.B) @ effects
    return np.asarray(to_mm @ state @ to_mm.T)


def _scatter_mm2(mm: FloatArray) -> FloatArray:
    """Covariance (2, 2) of the steps between rows (n, 2), robustly; 0 of few rows."""
    if len(mm) <= _ENOUGH_STEPS:
        return np.zeros((2, 2))
    steps = np.diff(mm, axis=0)
    return np.diag((_MAD * np.median(np.abs(steps - np.median(steps, axis=0)), axis=0)) ** 2)
