"""The chain of calibrations from the record's zero, by least squares over all that was observed."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement
from daemon.store.records import DatumMethod, DatumRecord, DatumStep

Targets = Mapping[str, Displacement]

NOTHING = Displacement(np.zeros(2), np.zeros((2, 2)))
"""The datum of the calibration that a record begins with."""
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


def origin(created_utc: datetime, reference_utc: datetime | None) -> DatumRecord:
    """The link of a calibration that has none before it."""
    return DatumRecord(
        DatumMethod.ORIGIN, NOTHING, (), created_utc, reference_utc, detail="the record begins here"
    )


def datum_by(step: DatumStep, base: DatumRecord | None) -> tuple[Displacement, Targets]:
    """Where one step leads to, for the main target and for further ones."""
    main = NOTHING if base is None else base.offset
    assert step.offset is not None  # noqa: S101 - steps of further targets alone come with others
    return added(main, step.offset), targets_by(step, base)


def targets_by(step: DatumStep, base: DatumRecord | None) -> Targets:
    """Where one step leads to, for the further targets that it names."""
    before = {} if base is None else base.targets
    return {name: added(before.get(name, NOTHING), own) for name, own in step.targets.items()}


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
    main = solve(_observed(chain, None))
    names = {name for link in chain.values() for step in link.steps for name in step.targets}
    further = {name: solve(_observed(chain, name)) for name in sorted(names)}
    found: dict[int, DatumRecord] = {}
    for number, link in chain.items():
        offset = main.get(number, link.offset)
        targets = {name: solved[number] for name, solved in further.items() if number in solved}
        if number in changed or not _same(offset, link.offset):
            found[number] = replace(link, offset=offset, targets=targets, created_utc=created_utc)
    return found


def solve(observed: Collection[Observation]) -> dict[int, Displacement]:
    """Least squares of all observations; a reference that was not observed is at the zero."""
    numbers = sorted({one.of_id for one in observed})
    place = {number: 2 * at for at, number in enumerate(numbers)}
    normal: FloatArray = np.zeros((2 * len(numbers), 2 * len(numbers)))
    right: FloatArray = np.zeros(2 * len(numbers))
    for one in observed:
        weight = np.linalg.inv(one.offset.covariance_mm2 + _LEAST_MM2 * np.eye(2))
        design: FloatArray = np.zeros((2, len(right)))
        design[:, place[one.of_id] : place[one.of_id] + 2] = np.eye(2)
        if one.from_id in place:
            design[:, place[one.from_id] : place[one.from_id] + 2] -= np.eye(2)
        normal += design.T @ weight @ design
        right += design.T @ weight @ one.offset.mm
    covariance = np.linalg.inv(normal)
    mm = covariance @ right
    return {
        number: Displacement(mm[at : at + 2], covariance[at : at + 2, at : at + 2])
        for number, at in place.items()
    }


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


def _observed(chain: Mapping[int, DatumRecord], target: str | None) -> list[Observation]:
    return [
        Observation(number, step.from_id, seen)
        for number, link in chain.items()
        for step, seen in _seen(link.steps, target)
    ]


def _seen(
    steps: Iterable[DatumStep], target: str | None
) -> Iterable[tuple[DatumStep, Displacement]]:
    for step in steps:
        seen = step.offset if target is None else step.targets.get(target)
        if seen is not None:
            yield step, seen


def _same(one: Displacement, other: Displacement) -> bool:
    return bool(
        np.allclose(one.mm, other.mm, rtol=0.0, atol=_SAME_MM)
        and np.allclose(one.covariance_mm2, other.covariance_mm2, rtol=1e-6, atol=_SAME_MM**2)
    )
