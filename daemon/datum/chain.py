"""The chain of calibrations from the record's zero, by least squares over all that was observed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from types import MappingProxyType

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement
from core.rig.reference_errors import ReferenceErrors
from core.site import MAIN
from daemon.store.records import DatumMethod, DatumRecord, DatumStep

NOTHING = Displacement(np.zeros(2), np.zeros((2, 2)))
"""The datum of the calibration that a record begins with."""
NO_ERRORS: Mapping[int, ReferenceErrors] = MappingProxyType({})
"""Of references of which nothing is known but where they lie."""
_LEAST_MM2 = 1e-12
"""Variance of a value given as exact."""
_SAME_MM = 1e-9
"""Two solutions that differ by less are one."""


@dataclass(frozen=True, slots=True)
class Observation:
    """One reference seen from another, or from the record's zero."""

    of_id: int
    from_id: int | None
    offset: Displacement
    by_errors: FloatArray | None = None
    """(2, m) how it follows the errors of the reference that was seen; None: not at all."""
    by_errors_before: FloatArray | None = None
    """(2, m) likewise of the one that it was seen from, with the opposite sign."""
    is_same: bool = False
    """Whether both are one reference, and have one error."""


@dataclass(frozen=True, slots=True)
class Solved:
    """Where a reference lies in the record's zero."""

    offset: Displacement
    shared: FloatArray | None
    """(m, 2) covariance of the reference's own errors with the offset; None: not known."""


def origin(
    created_utc: datetime, reference_utc: datetime | None, errors: ReferenceErrors | None = None
) -> DatumRecord:
    """The link of a calibration that has none before it."""
    words = "the record begins here"
    return DatumRecord(
        DatumMethod.ORIGIN, NOTHING, (), created_utc, reference_utc, errors=errors, detail=words
    )


def offset_by(step: DatumStep, base: DatumRecord | None, new: ReferenceErrors | None) -> Solved:
    """Where one step leads to, for the main target."""
    assert step.offset is not None  # noqa: S101 - steps of further targets alone come with others
    return _led_to(step, step.offset, MAIN, base, new)


def targets_by(
    step: DatumStep, base: DatumRecord | None, new: ReferenceErrors | None
) -> dict[str, Solved]:
    """Where one step leads to, for the further targets that it names."""
    return {name: _led_to(step, own, name, base, new) for name, own in step.targets.items()}


def _led_to(
    step: DatumStep,
    seen: Displacement,
    target: str,
    base: DatumRecord | None,
    new: ReferenceErrors | None,
) -> Solved:
    before, offset, shared = None, NOTHING, None
    if base is not None:
        before, shared = base.errors, base.shared.get(target)
        offset = base.offset if target == MAIN else base.targets.get(target, NOTHING)
    one = _observation((0, 1), step, seen, target, (new, before))
    if one.is_same:
        return Solved(added(offset, seen), shared)
    mm2 = offset.covariance_mm2 + _own_mm2(one, new, before)
    mm2 = mm2 + _of_errors_mm2(one.by_errors, new)
    mm2 = mm2 + _of_errors_mm2(one.by_errors_before, before)
    if one.by_errors_before is not None and shared is not None:
        with_base = one.by_errors_before @ shared
        mm2 = mm2 - with_base - with_base.T
    return Solved(Displacement(offset.mm + seen.mm, mm2), _shared_with(one, new))


def _shared_with(one: Observation, new: ReferenceErrors | None) -> FloatArray | None:
    if new is None:
        return None
    if one.by_errors is None:
        return np.zeros((len(new.covariance), 2))
    return np.asarray(new.covariance @ one.by_errors.T)


def added(one: Displacement, other: Displacement) -> Displacement:
    """The sum of two independent displacements."""
    return Displacement(one.mm + other.mm, one.covariance_mm2 + other.covariance_mm2)


def relinked(
    links: Mapping[int, DatumRecord], changed: Mapping[int, DatumRecord], created_utc: datetime
) -> dict[int, DatumRecord]:
    """Solve the chain with some links changed; give those and all that follow from them.

    Links hold what was observed (`steps`); offsets of the changed ones need not be right yet.
    """
    chain = {**links, **changed}
    errors = {number: link.errors for number, link in chain.items() if link.errors is not None}
    names = {name for link in chain.values() for step in link.steps for name in step.targets}
    solved = {name: solve(_observed(chain, name), errors) for name in (MAIN, *sorted(names))}
    found: dict[int, DatumRecord] = {}
    for number, link in chain.items():
        own = {name: places[number] for name, places in solved.items() if number in places}
        offset = own[MAIN].offset if MAIN in own else link.offset
        if number not in changed and _same(offset, link.offset):
            continue
        found[number] = replace(
            link,
            offset=offset,
            targets={name: one.offset for name, one in own.items() if name != MAIN},
            shared={name: one.shared for name, one in own.items() if one.shared is not None},
            created_utc=created_utc,
        )
    return found


def solve(
    observed: Collection[Observation], errors: Mapping[int, ReferenceErrors] = NO_ERRORS
) -> dict[int, Solved]:
    """Least squares of all observations; a reference that was not observed is at the zero.

    The errors of the references are unknowns with their covariance as prior: what two observations
    of one reference have alike, or with opposite signs, is known so.
    """
    numbers = sorted({one.of_id for one in observed})
    place = {number: slice(2 * at, 2 * at + 2) for at, number in enumerate(numbers)}
    roots = {number: _root(one.covariance) for number, one in errors.items()}
    places, size = _places_of_errors(observed, roots, 2 * len(numbers))
    normal, right = np.zeros((size, size)), np.zeros(size)
    normal[2 * len(numbers) :, 2 * len(numbers) :] = np.eye(size - 2 * len(numbers))
    for one in observed:
        design: FloatArray = np.zeros((2, size))
        design[:, place[one.of_id]] = np.eye(2)
        if one.from_id in place:
            design[:, place[one.from_id]] -= np.eye(2)
        if one.by_errors is not None:
            design[:, places[one.of_id]] += one.by_errors @ roots[one.of_id]
        if one.by_errors_before is not None and one.from_id is not None:
            design[:, places[one.from_id]] -= one.by_errors_before @ roots[one.from_id]
        own_mm2 = _own_mm2(one, errors.get(one.of_id), errors.get(one.from_id or 0))
        weight = np.linalg.inv(own_mm2 + _LEAST_MM2 * np.eye(2))
        normal += design.T @ weight @ design
        right += design.T @ weight @ one.offset.mm
    covariance = np.linalg.inv(normal)
    state = covariance @ right
    return {
        number: Solved(
            Displacement(state[at], covariance[at, at]),
            # The block is of what is unknown, the truth less the estimate: of an offset that is
            # the error with the other sign.
            -roots[number] @ covariance[places[number], at] if number in roots else None,
        )
        for number, at in place.items()
    }


def _places_of_errors(
    observed: Collection[Observation], roots: Mapping[int, FloatArray], start: int
) -> tuple[dict[int, slice], int]:
    """Where the errors of each reference are among the unknowns, and how many unknowns there are.

    Calibrations of one reference share its errors.
    """
    same = {one.of_id: one.from_id for one in observed if one.is_same}
    places: dict[int, slice] = {}
    for number in sorted(roots):
        earlier = same.get(number)
        if earlier in places and len(roots[earlier]) == len(roots[number]):
            places[number] = places[earlier]
            continue
        places[number] = slice(start, start + len(roots[number]))
        start += len(roots[number])
    return places, start


def _root(covariance: FloatArray) -> FloatArray:
    """The symmetric root of a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _own_mm2(
    one: Observation, new: ReferenceErrors | None, before: ReferenceErrors | None
) -> FloatArray:
    """(2, 2) what an observation's covariance holds beside the errors of the references."""
    rest = one.offset.covariance_mm2 - _of_errors_mm2(one.by_errors, new)
    rest = rest - _of_errors_mm2(one.by_errors_before, before)
    values, vectors = np.linalg.eigh(rest)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _of_errors_mm2(by_errors: FloatArray | None, errors: ReferenceErrors | None) -> FloatArray:
    if by_errors is None or errors is None:
        return np.zeros((2, 2))
    return np.asarray(by_errors @ errors.covariance @ by_errors.T)


def weighted_mean(offsets: Sequence[Displacement]) -> Displacement:
    """The mean of several looks at one offset; what all of them share is not averaged out.

    Their scatter counts where it is more than their sigmas say.
    """
    own = [one.covariance_mm2 - _shared(one) + _LEAST_MM2 * np.eye(2) for one in offsets]
    weights = [np.linalg.inv(covariance) for covariance in own]
    mean_mm2 = np.linalg.inv(np.sum(weights, axis=0))
    mm = mean_mm2 @ np.sum([w @ one.mm for w, one in zip(weights, offsets, strict=True)], axis=0)
    left = [one.mm - mm for one in offsets]
    chi2 = sum(float(r @ w @ r) for r, w in zip(left, weights, strict=True))
    wider = max(1.0, chi2 / max(1, 2 * len(offsets) - 2))
    shared = np.mean([_shared(one) for one in offsets], axis=0)
    return Displacement(mm, wider * mean_mm2 + shared, shared)


def _shared(one: Displacement) -> FloatArray:
    return np.zeros((2, 2)) if one.shared_mm2 is None else one.shared_mm2


def _observed(chain: Mapping[int, DatumRecord], target: str) -> list[Observation]:
    found = []
    for number, link in chain.items():
        for step in link.steps:
            seen = step.offset if target == MAIN else step.targets.get(target)
            if seen is not None:
                base = chain.get(step.from_id or 0)
                errors = link.errors, None if base is None else base.errors
                ids = number, step.from_id
                found.append(_observation(ids, step, seen, target, errors))
    return found


def _observation(
    ids: tuple[int, int | None],
    step: DatumStep,
    seen: Displacement,
    target: str,
    errors: tuple[ReferenceErrors | None, ReferenceErrors | None],
) -> Observation:
    """What a step says of a target; errors are the new reference's and those of the one before."""
    now, before = (
        None
        if gains is None or known is None or target not in gains
        else known.by_values(target, gains[target])
        for gains, known in zip((step.now, step.before), errors, strict=True)
    )
    is_same = step.method is DatumMethod.SAME_REFERENCE
    return Observation(*ids, seen, now, before, is_same)


def _same(one: Displacement, other: Displacement) -> bool:
    return bool(
        np.allclose(one.mm, other.mm, rtol=0.0, atol=_SAME_MM)
        and np.allclose(one.covariance_mm2, other.covariance_mm2, rtol=1e-6, atol=_SAME_MM**2)
    )
