"""Two calibrations that measure the same frames: the offset between their references."""

from __future__ import annotations

from collections.abc import Iterable

from core.results import Displacement, Flag, Measurement
from daemon.datum.candidates import gains_of, mean_gains, measured_targets
from daemon.datum.chain import weighted_mean
from daemon.store.records import DatumMethod, DatumStep

FEWEST = 3
"""Pairs that both calibrations must measure well."""


def overlap_step(
    measured: Iterable[tuple[Measurement, Measurement]], earlier_id: int
) -> tuple[DatumStep | None, int]:
    """Where the later reference lies from the earlier one, and by how many pairs.

    measured is what the earlier and the later calibration say of each pair. None where fewer than
    `FEWEST` are good by both.
    """
    both = [
        (one, other) for one, other in measured if one.flag is Flag.GOOD and other.flag is Flag.GOOD
    ]
    if len(both) < FEWEST:
        return None, len(both)
    main = _mean(
        _less(one.corrected, other.corrected)
        for one, other in both
        if one.corrected is not None and other.corrected is not None
    )
    names = {name for one, _ in both for name, _ in measured_targets(one)}
    targets = {}
    for name in sorted(names):
        seen = [(dict(measured_targets(a)), dict(measured_targets(b))) for a, b in both]
        pairs = [(a[name], b[name]) for a, b in seen if name in a and name in b]
        if len(pairs) >= FEWEST:
            targets[name] = _mean(_less(a, b) for a, b in pairs)
    before, now = (mean_gains([gains_of(one) for one in side]) for side in zip(*both, strict=True))
    return DatumStep(DatumMethod.ADJUSTED, earlier_id, main, targets, now, before), len(both)


def _less(one: Displacement, other: Displacement) -> Displacement:
    """The difference of what two calibrations say of one pair; their errors are independent."""
    shared = [d.shared_mm2 for d in (one, other) if d.shared_mm2 is not None]
    return Displacement(
        one.mm - other.mm,
        one.covariance_mm2 + other.covariance_mm2,
        sum(shared[1:], shared[0]) if shared else None,
    )


def _mean(differences: Iterable[Displacement]) -> Displacement:
    mean = weighted_mean(list(differences))
    return Displacement(mean.mm, mean.covariance_mm2)
