"""The uncertainty budget of one row after GUM and EA-4/02: its inputs, combined and expanded.

Model: d = inv(B~) (u - u_ref - u_false(R, T; rig)) - G c + datum, with c what fixed targets show
and G the gain of their conditioning. Inputs of the calibration are correlated; their parts
are signed factors, whose sum is squared.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from core.arrays import FloatArray
from core.checkerboard.resection import BoardView
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import DiscCombination
from core.rig.reference_errors import ReferenceErrors
from core.rig.stability import Term
from core.site import Site

COVERAGE = 0.9545
"""Coverage probability of U, by the convention of EA-4/02."""
RELIABILITY = 0.25
"""Relative uncertainty of a standard uncertainty that is itself an estimate (the stability budget).
Chosen; by GUM G.4.2 it stands for 8 degrees of freedom."""
_MANY = 1000.0
"""Degrees of freedom from which a t distribution is as good as normal."""


@dataclass(frozen=True, slots=True)
class RowState:
    """What a row says of how it came about."""

    motion: Pose
    """`T_CSj_CS1`."""
    motion_covariance: FloatArray
    """(6, 6) of this frame's corners."""
    raw_mm2: Mapping[str, FloatArray]
    """(2, 2) covariance of the raw displacement of each target seen, by name, from the reference of
    the row's calibration."""
    raw_mm: Mapping[str, FloatArray]
    """(2,) raw displacement of each target seen, by name."""
    believed: Collection[str] = ()
    """Fixed targets whose closure was taken off."""
    corners: int = 0
    """That the pose rests on."""
    image_mm2: FloatArray | None = None
    """(2, 2) the part of its covariance that pixels and calibration give, where it is known."""


@dataclass(frozen=True, slots=True)
class Input:
    """One line of the budget."""

    name: str
    evaluation: str
    """A or B, as GUM has it."""
    distribution: str
    unit: str
    """Of the input's standard uncertainty."""
    covariance_mm2: FloatArray
    """(2, 2) its part of the displacement's covariance."""
    degrees_of_freedom: float = math.inf
    u: float | None = None
    """Standard uncertainty in its own unit; None: as it acts on the displacement, in mm."""
    factor_mm: FloatArray | None = None
    """(2, r) signed, of a correlated input: parts add before they are squared."""

    def contribution_mm(self, axis: int) -> float:
        """|c| u along x (0) or y (1)."""
        return math.sqrt(max(float(self.covariance_mm2[axis, axis]), 0.0))

    def standard_uncertainty(self, axis: int) -> float:
        """Give u of the input."""
        return self.contribution_mm(axis) if self.u is None else self.u

    def sensitivity(self, axis: int) -> float:
        """|c| along an axis, mm per unit of the input."""
        if self.u is None:
            return 1.0
        return self.contribution_mm(axis) / self.u if self.u > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Expanded:
    """The combined and the expanded uncertainty along one axis."""

    combined_mm: float
    degrees_of_freedom: float
    """Effective, by Welch and Satterthwaite."""
    coverage_factor: float
    expanded_mm: float


@dataclass(frozen=True, slots=True)
class DatumPart:
    """The datum of a row's calibration."""

    covariance_mm2: FloatArray
    """(2, 2)."""
    errors: ReferenceErrors | None = None
    """Of the reference, which are in row and datum alike; None: not known."""
    shared: FloatArray | None = None
    """(m, 2) covariance of these errors with the datum."""


@dataclass(frozen=True, slots=True)
class BudgetModel:
    """The measurement model at a row, with the parts of its errors: what a Monte Carlo draws."""

    site: Site
    calibrated: CalibratedSite
    row: RowState
    targets: tuple[CalibratedTarget, ...]
    combinations: tuple[DiscCombination, ...]
    disc_px2: tuple[FloatArray, ...]
    """(2, 2) of one disc of each target in this frame."""
    view: BoardView
    terms: tuple[Term, ...]
    keep_mm: FloatArray
    """(2, m) from the targets' values (px, rad) to the displacement."""
    own_mm: FloatArray
    """(m,) 1 sigma of fixed targets' own movement, by value."""
    to_mm: FloatArray
    """(m, m)."""
    rows: tuple[slice, ...]
    places_px: tuple[FloatArray, ...]
    """(2,) where the discs of each target are in the row, in the mean."""
    datum_mm2: FloatArray
    """(2, 2) of the datum, beside the two next ones."""
    datum_by_calibration_mm: FloatArray
    """(2, r) how the datum follows the posterior's columns."""
    datum_by_places_mm: FloatArray
    """(2, m) how it follows the targets' values (px, rad) at the reference."""


@dataclass(frozen=True, slots=True)
class Budget:
    """All inputs of a row's displacement."""

    inputs: tuple[Input, ...]
    """Independent ones, and those with a factor, which are correlated with one another."""
    scale_px_per_mm: float
    model: BudgetModel

    @property
    def correlated(self) -> tuple[Input, ...]:
        """Inputs of the calibration, adjusted together."""
        return tuple(one for one in self.inputs if one.factor_mm is not None)

    @property
    def calibration_mm2(self) -> FloatArray:
        """(2, 2) of the correlated inputs together."""
        factors = [one.factor_mm for one in self.correlated if one.factor_mm is not None]
        whole = sum(factors, np.zeros_like(factors[0]))
        return np.asarray(whole @ whole.T)

    @property
    def covariance_mm2(self) -> FloatArray:
        """(2, 2) of the displacement."""
        alone = [one.covariance_mm2 for one in self.inputs if one.factor_mm is None]
        return np.asarray(sum(alone, self.calibration_mm2))

    def correlations(self, axis: int) -> FloatArray:
        """(n, n) correlation coefficients of the correlated inputs' effects along an axis."""
        rows = np.array([one.factor_mm[axis] for one in self.correlated])  # type: ignore[index]
        size = np.maximum(np.linalg.norm(rows, axis=1), 1e-30)
        return np.asarray(rows @ rows.T / np.outer(size, size))

    def expanded(self, axis: int) -> Expanded:
        """Combine along x (0) or y (1): u, effective degrees of freedom, k and U."""
        combined_mm = math.sqrt(float(self.covariance_mm2[axis, axis]))
        shares = [
            one.contribution_mm(axis) ** 4 / one.degrees_of_freedom
            for one in self.inputs
            if one.factor_mm is None
        ]
        dof = combined_mm**4 / sum(shares) if sum(shares) > 0.0 else math.inf
        dof = math.inf if dof > _MANY else float(max(math.floor(dof), 1))
        k = coverage_factor(dof)
        return Expanded(combined_mm, dof, k, k * combined_mm)


def coverage_factor(degrees_of_freedom: float) -> float:
    """Coverage factor for 95.45 %, of Student's t.

    >>> round(coverage_factor(math.inf), 2), round(coverage_factor(10), 2)
    (2.0, 2.28)
    """
    if math.isinf(degrees_of_freedom):
        return float(ndtri(0.5 + 0.5 * COVERAGE))
    return float(stdtrit(degrees_of_freedom, 0.5 + 0.5 * COVERAGE))


def two_digits(value: float, expanded: float) -> tuple[str, str]:
    """A value and its U as a statement gives them: U to two significant digits, the value as far.

    U is rounded up where rounding down would make it smaller by more than 5 % (EA-4/02).

    >>> two_digits(-3.21417, 0.12345), two_digits(12.0, 0.0996), two_digits(0.5, 23.4)
    (('-3.21', '0.12'), ('12.00', '0.10'), ('0', '23'))
    """
    if not expanded > 0.0:
        return f"{value:.3f}", "0"
    place = 1 - math.floor(math.log10(expanded))
    rounded = round(expanded, place)
    if rounded < expanded / 1.05:
        rounded = math.ceil(expanded * 10.0**place) / 10.0**place
    place = max(1 - math.floor(math.log10(rounded)), 0)
    shown = round(value, place) + 0.0  # no -0
    return f"{shown:.{place}f}", f"{rounded:.{place}f}"
