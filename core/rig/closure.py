"""One estimate from all targets of a pair: what the fixed ones show is taken off the others.

The errors of all targets' shifts are Gaussian with a joint covariance: the pixels' and the
calibration's, and, with the stability budget as prior, what may have changed since. A fixed
target's shift is nothing but error. So the error of the others, given it, is the conditional
expectation, and its covariance the conditional one. Fewer fixed targets, or none, are the same
formula with fewer rows.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray
from core.results import Displacement
from core.rig.compensation import Shifts
from core.rig.stability import STATE, Prior, Term, state_effects, total_covariance
from core.site import Site

_MOVED = 30.0
"""Squared distance, in sigmas, from which a fixed target has moved by itself: of a normal
distribution in two dimensions one row in three million, some three in a year of minutes, is beyond
it, and rows side by side err alike."""
_BEYOND = 20.0
"""Likewise for a closure that the budget does not explain: 1 in 22,000 of independent calibrations;
rows of one calibration share what has changed."""


@dataclass(frozen=True, slots=True)
class JointShifts:
    """Shifts of all targets, mm, with the joint covariance of their errors."""

    names: tuple[str, ...]
    fixed: tuple[bool, ...]
    rows: tuple[slice, ...]
    """Of the values below, for each target: its shift (2, mm) and, for a fixed one, its own turn
    (rad) and relative change of scale."""
    values: FloatArray
    """(m,) with the rig's motion off, and nothing else."""
    image: FloatArray
    """(m, m) covariance from the pixels and the calibration."""
    shared: FloatArray
    """(m, m) the part of that which is the same in every frame."""
    stability: FloatArray
    """(m, m) from what may have changed since the calibration; the same in the frames of a slot.
    Of fixed targets, their own movement too."""

    @property
    def covariance(self) -> FloatArray:
        """(m, m) of the whole error."""
        return self.image + self.stability

    def shift_of(self, name: str) -> IntArray:
        """Indices (2,) of a target's shift."""
        start = self.rows[self.names.index(name)].start
        return np.array([start, start + 1])

    def all_of(self, names: Collection[str]) -> IntArray:
        """Indices of all values of some targets."""
        chosen = [rows for name, rows in zip(self.names, self.rows, strict=True) if name in names]
        return np.array([k for rows in chosen for k in range(rows.start, rows.stop)], dtype=int)

    def shifts_of(self, names: Collection[str]) -> IntArray:
        """Indices of the shifts of some targets."""
        return np.array([k for n in self.names if n in names for k in self.shift_of(n)], dtype=int)


def joint_shifts(
    shifts: Shifts,
    site: Site,
    centre_px: FloatArray,
    terms: Sequence[Term],
    prior: Prior | None = None,
) -> JointShifts:
    """Bring shifts to mm, with what may have changed since the calibration (`stability_terms`).

    A prior takes the place of these terms; what it lets expect is taken off all but fixed targets.
    """
    to_mm, main_mm = shifts.to_mm, site.main_target.distance_mm
    if prior is None:
        covariance = total_covariance(terms)
        prior = Prior(np.zeros(STATE), covariance)
    effects = to_mm @ np.concatenate(
        [
            state_effects(target, place_px, centre_px, main_mm)[: rows.stop - rows.start]
            for target, place_px, rows in zip(
                shifts.targets, shifts.places_px, shifts.rows, strict=True
            )
        ]
    )
    stable_mm = {extra.name: extra.stable_mm for extra in site.extra_targets}
    own_mm2, expected = np.zeros(len(shifts.values)), effects @ prior.mean
    for target, rows in zip(shifts.targets, shifts.rows, strict=True):
        if target.is_fixed:
            own_mm2[rows.start : rows.start + 2] = stable_mm.get(target.name, 0.0) ** 2
            expected[rows] = 0.0
    return JointShifts(
        tuple(target.name for target in shifts.targets),
        tuple(target.is_fixed for target in shifts.targets),
        shifts.rows,
        to_mm @ shifts.values - expected,
        to_mm @ shifts.covariance @ to_mm.T,
        to_mm @ shifts.shared @ to_mm.T,
        effects @ prior.covariance @ effects.T + np.diag(own_mm2),
    )


def close(joint: JointShifts, believed: Collection[str]) -> dict[str, Displacement]:
    """Displacements of all targets, the error that the believed fixed ones show taken off the rest.

    Of a fixed target: what the rig alone says of it.
    """
    given, nothing = joint.all_of(believed), joint.all_of(())
    return {
        name: _conditional(joint, joint.shift_of(name), nothing if fixed else given)
        for name, fixed in zip(joint.names, joint.fixed, strict=True)
    }


def gains_of(joint: JointShifts, believed: Collection[str], name: str) -> dict[str, FloatArray]:
    """What of the believed fixed targets' values `close` takes off another target's shift.

    (2, 4) by the fixed target's name; none off a fixed one.
    """
    if joint.fixed[joint.names.index(name)] or not believed:
        return {}
    gain = _gain(joint.covariance, joint.shift_of(name), joint.all_of(believed))
    taken = [fixed for fixed in joint.names if fixed in believed]
    return dict(zip(taken, np.split(gain, len(taken), axis=1), strict=True))


def _conditional(joint: JointShifts, own: IntArray, given: IntArray) -> Displacement:
    """Values less the error that others (given), which are nothing but error, let expect."""
    rows = np.concatenate([own, given])
    keep = np.concatenate([np.eye(2), -_gain(joint.covariance, own, given)], axis=1)

    def left(covariance: FloatArray) -> FloatArray:
        return np.asarray(keep @ covariance[np.ix_(rows, rows)] @ keep.T)

    return Displacement(
        keep @ joint.values[rows],
        left(joint.covariance),
        left(joint.shared + joint.stability),
        left(joint.image),
    )


def consistent(joint: JointShifts, fixed: Collection[str]) -> list[str]:
    """The fixed targets that agree with one another: the others have moved by themselves.

    Where two disagree, and no third one says which is right, the one is left that asks less of
    the stability budget.
    """
    left = [name for name in joint.names if name in fixed]
    while len(left) > 1:
        away = [_disagreement(joint, name, [n for n in left if n != name]) for name in left]
        if max(away) < _MOVED:
            break
        if len(left) == 2:
            away = [_disagreement(joint, name, []) for name in left]
        del left[int(np.argmax(away))]
    return left


def _disagreement(joint: JointShifts, name: str, others: Collection[str]) -> float:
    """Squared distance, in sigmas, of a target's shift from what some others let expect."""
    own, given = joint.shift_of(name), joint.all_of(others)
    left = _conditional(joint, own, given)
    return float(left.mm @ np.linalg.solve(left.covariance_mm2, left.mm))


def is_beyond(closure: Displacement) -> bool:
    """Whether a closure is larger than the stability budget allows."""
    return float(closure.mm @ np.linalg.solve(closure.covariance_mm2, closure.mm)) > _BEYOND


def _gain(covariance: FloatArray, own: IntArray, given: IntArray) -> FloatArray:
    """(own, given): the conditional expectation of some coordinates' error is this by the given."""
    known = covariance[np.ix_(given, given)]
    return np.asarray(np.linalg.solve(known, covariance[np.ix_(given, own)]).T)


def closure_of(joint: JointShifts, believed: Collection[str]) -> Displacement | None:
    """What the believed fixed targets together seem to have moved by: the rig's own error.

    Their mean, weighted by what pixels, calibration and own movement leave uncertain. None
    without any.
    """
    fixed = joint.shifts_of(believed)
    if not len(fixed):
        return None
    block = np.ix_(fixed, fixed)
    image = joint.image[block]
    each = np.tile(np.eye(2), (len(fixed) // 2, 1))
    weights = np.linalg.solve(each.T @ np.linalg.solve(image, each), each.T @ np.linalg.inv(image))
    return Displacement(
        weights @ joint.values[fixed],
        weights @ joint.covariance[block] @ weights.T,
        weights @ (joint.shared + joint.stability)[block] @ weights.T,
        weights @ image @ weights.T,
    )
