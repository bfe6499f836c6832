"""The datum's part of a row's uncertainty: what it has in common with the row, and the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from core.analysis.budget import DatumPart, Input
from core.arrays import FloatArray
from core.rig.propagation import DiscCombination


@dataclass(frozen=True, slots=True)
class Linked:
    """The error of a row's datum, split."""

    by_calibration_mm: FloatArray
    """(2, r) by the posterior's columns."""
    by_places_mm: FloatArray
    """(2, m) by the errors of the values at the reference (px, rad)."""
    rest_mm2: FloatArray
    """(2, 2)."""


def link_of(
    datum: DatumPart | None, names: Sequence[str], to_mm: FloatArray, of_reference: FloatArray
) -> Linked:
    """Split the datum's error by the errors of the reference, on which it depends linearly.

    names are those of the row's targets; to_mm (m, m) brings their values to mm. of_reference (m,
    r) is how the row's values follow the noise of the reference, by the posterior's columns.
    """
    by_places = np.zeros((2, len(of_reference)))
    if datum is None:
        return Linked(by_places @ of_reference, by_places, np.zeros((2, 2)))
    known, rest_mm2 = datum.errors, datum.covariance_mm2
    if known is not None and datum.shared is not None and set(names) <= set(known.names):
        at = known.places_in_row(names)
        shared = datum.shared[at]
        by_errors = shared.T @ np.linalg.pinv(known.covariance[np.ix_(at, at)], rcond=1e-9)
        rest_mm2 = rest_mm2 - by_errors @ shared
        by_places = by_errors @ to_mm
    # The row errs by the reference's errors with the opposite sign.
    return Linked(-by_places @ of_reference, by_places, rest_mm2)


def by_reference_input(linked: Linked, places_root_px: FloatArray) -> Input:
    """What datum and row have in common; signed as the row's own inputs.

    places_root_px (m, q) is the root of the covariance of fixed targets' places in the reference.
    """
    factor = [linked.by_calibration_mm, linked.by_places_mm @ places_root_px]
    mm = np.concatenate(factor, axis=1)
    name = "datum: by the noise of the reference, which it has measured too"
    return Input(name, "A", "normal", "mm", mm @ mm.T, factor_mm=mm)


def rest_input(linked: Linked) -> Input:
    """The rest of the datum's uncertainty."""
    name = "datum: the calibration's reference in the record's zero"
    return Input(name, "A, B", "normal", "mm", linked.rest_mm2)


def places_root(combinations: Sequence[DiscCombination]) -> FloatArray:
    """(m, q) root of the covariance of further targets' places in the reference.

    The posterior has those of the main one.
    """
    roots = [
        (one.sums * np.sqrt(one.target.reference_px2[one.which])[:, None]).reshape(
            len(one.sums), -1
        )
        for one in combinations
    ]
    whole = scipy.linalg.block_diag(*roots)
    return np.asarray(whole[:, np.any(whole != 0.0, axis=0)])
