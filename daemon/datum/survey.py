"""A surveyed value: what it replaces in a link, coordinate by coordinate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement
from daemon.datum.chain import NOTHING
from daemon.store.records import DatumMethod, DatumRecord, DatumStep

_UNSEEN_MM2 = 1e8
"""Variance of a coordinate that was not observed: 10 m."""


def surveyed(
    link: DatumRecord | None,
    x_mm: float | None,
    y_mm: float | None,
    sigma_mm: float,
    source: str,
    created_utc: datetime,
) -> DatumRecord:
    """The link with the given coordinates taken from a survey; the other one rests on what it did.

    Its offset is still the old one: `relinked` solves the chain.
    """
    given = np.array([x_mm is not None, y_mm is not None])
    value_mm = np.array([x_mm or 0.0, y_mm or 0.0])
    own_mm2 = np.diag(np.where(given, sigma_mm**2, _UNSEEN_MM2))
    survey = DatumStep(DatumMethod.SURVEY, None, Displacement(value_mm, own_mm2))
    before = DatumRecord(DatumMethod.ORIGIN, NOTHING, (), created_utc) if link is None else link
    return replace(
        before,
        method=DatumMethod.SURVEY,
        steps=(survey, *_left(before, given)),
        created_utc=created_utc,
        detail=source,
    )


def _left(before: DatumRecord, given: FloatArray) -> Iterator[DatumStep]:
    """What the steps before still say: the other coordinate, and further targets."""
    if not before.steps and not given.all():
        fixed = DatumStep(DatumMethod.ORIGIN, None, _unseen(NOTHING, given))
        yield fixed
    for step in before.steps:
        main = None if given.all() or step.offset is None else _unseen(step.offset, given)
        if main is not None or step.targets:
            yield replace(step, offset=main)


def _unseen(offset: Displacement, given: FloatArray) -> Displacement:
    """The same displacement with some coordinates not observed."""
    kept = ~given.astype(bool)
    covariance_mm2 = offset.covariance_mm2 * np.outer(kept, kept)
    covariance_mm2 += np.diag(np.where(kept, 0.0, _UNSEEN_MM2))
    return Displacement(np.where(kept, offset.mm, 0.0), covariance_mm2)
