"""The uncertainty budget of one row after GUM and EA-4/02: the row's own covariance, by cause.

Model: d = inv(B~) (u - u_ref - u_false(R, T; rig)) - G c + datum, with c what fixed targets show
and G the gain of their conditioning. Each input's part of the covariance of d is carried through
the same derivatives as in `core.rig.compensation` and `core.rig.closure`, so that all parts
together are what the row carries. Inputs of the calibration are correlated; their parts
are signed factors, whose sum is squared.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize, stats

from core.arrays import FloatArray
from core.checkerboard.resection import BoardView
from core.geometry.pose import Pose
from core.results import Displacement
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.posterior import Sensitivities
from core.rig.propagation import (
    DiscCombination,
    block_diagonal,
    expected_view,
    mean_of,
    predict_shift_of,
    sensitivity_through_pose,
    shift_sensitivities,
    turn_and_scale_of,
    turned_B,
)
from core.rig.stability import Term, main_scale, state_effects
from core.site import MAIN, Site

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
        return float(stats.norm.ppf(0.5 + 0.5 * COVERAGE))
    return float(stats.t.ppf(0.5 + 0.5 * COVERAGE, degrees_of_freedom))


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
    datum_mm2: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))


_BUDGET_KEYS = (
    ("cameras_urad_per_k", "µrad/K"),
    ("cameras_urad_per_sqrt_day", "µrad/√d"),
    ("board_urad_per_k", "µrad/K"),
    ("board_urad_per_sqrt_day", "µrad/√d"),
    ("board_expansion_per_k", "1/K"),
    ("main_px_per_k", "px/K"),
    ("sub_px_per_k", "px/K"),
    ("air_gradient_k_per_m", "K/m"),
)
"""The key of [stability] behind each of `stability_terms`, and its unit."""


def row_budget(
    site: Site,
    calibrated: CalibratedSite,
    row: RowState,
    terms: Sequence[Term],
    datum: Displacement | None = None,
) -> Budget:
    """Split what a row's sigma is made of by cause; terms are `stability_terms` at the row.

    The corners are taken to be those that the pose puts into the image.
    """
    targets = [
        one
        for one in (calibrated.main_target, *calibrated.further)
        if one.name == MAIN or (one.name in row.believed and one.name in row.raw_mm2)
    ]
    combinations, rows = _combinations(calibrated, targets, row.motion)
    pose = row.motion.compose(calibrated.reference_pose)
    view = expected_view(calibrated, site.sub, pose)
    sensitivities, _ = shift_sensitivities(calibrated, combinations, pose, view, view.whitening())
    by_motion = np.concatenate([c.of(c.prediction.by_motion) for c in combinations])
    corners = by_motion @ row.motion_covariance @ by_motion.T
    shared = sensitivities.covariance(calibrated.posterior)
    to_mm = _to_mm(calibrated, targets, rows, row.motion)
    own_mm = _own_movement(site, targets, rows)
    effects = np.concatenate(
        [
            state_effects(one, site.main.centre_px, site.main_target.distance_mm)[
                : s.stop - s.start
            ]
            for one, s in zip(targets, rows, strict=True)
        ]
    )
    stability = sum((effects @ t.covariance @ effects.T for t in terms), np.zeros_like(shared))
    parts = _Parts(
        combinations=tuple(combinations),
        one_disc_px2=tuple(_one_disc(calibrated, c, row) for c in combinations),
        others=corners + shared,
        stability=stability,
        to_mm=to_mm,
        own_mm=own_mm,
    )
    share = parts.disc_share(row.image_mm2)
    disc_px2 = tuple(share * px2 for px2 in parts.one_disc_px2)
    discs, keep = parts.discs(share), parts.keep(share)
    model = BudgetModel(
        site,
        calibrated,
        row,
        tuple(targets),
        tuple(combinations),
        disc_px2,
        view,
        tuple(terms),
        keep,
        own_mm,
        to_mm,
        tuple(rows),
        np.zeros((2, 2)) if datum is None else datum.covariance_mm2,
    )
    scale = main_scale(calibrated.B)
    inputs = [
        _image_input(
            "discs in the main image", discs, keep, scale, 2.0 * len(combinations[0].which) - 2.0
        ),
        Input(
            "pose of the board, from its corners in the sub image",
            "A",
            "normal",
            "mm",
            keep @ corners @ keep.T,
            max(2.0 * (row.corners or len(view.index)) - 6.0, 1.0),
        ),
        *_calibration_inputs(site, calibrated, sensitivities, keep),
        Input(
            "corners of the board, each by itself; plainness of the main camera's model",
            "B",
            "normal",
            "mm",
            keep @ sensitivities.own(calibrated.posterior) @ keep.T,
        ),
        *_stability_inputs(site, terms, keep @ effects),
    ]
    if own_mm.any():
        left = keep @ np.linalg.inv(to_mm)
        covariance = left @ np.diag(own_mm**2) @ left.T
        inputs.append(
            Input("fixed targets' own movement", "B", "normal", "mm", covariance, _estimated())
        )
    if datum is not None:
        inputs.append(
            Input(
                "datum: the calibration's reference in the record's zero",
                "A, B",
                "normal",
                "mm",
                datum.covariance_mm2,
            )
        )
    return Budget(tuple(inputs), scale, model)


_LEAST_SHARE = 1e-4
"""Of the scatter that the raw displacement shows, for the discs' own noise."""


@dataclass(frozen=True, slots=True)
class _Parts:
    """What the targets' values err by, px and rad."""

    combinations: tuple[DiscCombination, ...]
    one_disc_px2: tuple[FloatArray, ...]
    """(2, 2) of a disc of each target as the raw displacement has it: at most."""
    others: FloatArray
    """(m, m) of the corners and the calibration."""
    stability: FloatArray
    """(m, m)."""
    to_mm: FloatArray
    own_mm: FloatArray

    def discs(self, share: float) -> FloatArray:
        """(m, m) of the discs' noise."""
        return block_diagonal(
            [
                share * np.einsum("mka,ab,lkb->ml", c.sums, px2, c.sums)
                for c, px2 in zip(self.combinations, self.one_disc_px2, strict=True)
            ]
        )

    def keep(self, share: float) -> FloatArray:
        """(2, m) from the values to the displacement: inv(B~), and the gain of fixed targets."""
        whole = self.discs(share) + self.others + self.stability
        covariance = self.to_mm @ whole @ self.to_mm.T + np.diag(self.own_mm**2)
        return np.asarray(_keep(covariance) @ self.to_mm)

    def disc_share(self, image_mm2: FloatArray | None) -> float:
        """What of the raw scatter is the discs' own noise, so that the row's image part comes out.

        A roll of the rig scatters raw discs, too, and is taken off before they are corrected.
        """
        if image_mm2 is None:
            return 1.0

        def excess(log_share: float) -> float:
            share = math.exp(log_share)
            keep = self.keep(share)
            return float(np.trace(keep @ (self.discs(share) + self.others) @ keep.T - image_mm2))

        least = math.log(_LEAST_SHARE)
        if excess(0.0) <= 0.0:
            return 1.0
        if excess(least) >= 0.0:
            return _LEAST_SHARE
        return math.exp(float(optimize.brentq(excess, least, 0.0, xtol=1e-3)))


def _estimated() -> float:
    """Degrees of freedom of an estimate of this reliability, GUM G.3."""
    return 0.5 / RELIABILITY**2


def _combinations(
    calibrated: CalibratedSite, targets: Sequence[CalibratedTarget], motion: Pose
) -> tuple[list[DiscCombination], list[slice]]:
    """Mean shift of each target, and of a fixed one its turn and scale; all discs count alike."""
    combinations, rows, end = [], [], 0
    for target in targets:
        which = np.nonzero(np.isfinite(target.reference_px).all(axis=1))[0]
        weights = np.full(len(which), 1.0 / len(which))
        sums = mean_of(weights)
        if target.is_fixed:
            turn = turn_and_scale_of(weights, target.reference_px[which])
            sums = np.concatenate([sums, turn])
        prediction = predict_shift_of(calibrated, target, which, motion)
        combinations.append(DiscCombination(target, which, sums, prediction))
        rows.append(slice(end, end + len(sums)))
        end += len(sums)
    return combinations, rows


def _one_disc(
    calibrated: CalibratedSite, combination: DiscCombination, row: RowState
) -> FloatArray:
    """(2, 2) px^2 of one disc in this frame: the raw covariance less the reference's share."""
    target, n = combination.target, len(combination.which)
    raw_px2 = target.B @ row.raw_mm2[target.name] @ target.B.T
    if target.role is None:
        factor = calibrated.posterior.discs[combination.which].mean(axis=0)
        reference_px2 = factor @ factor.T
    else:
        reference_px2 = target.reference_px2[combination.which].mean() / n * np.eye(2)
    values, vectors = np.linalg.eigh(raw_px2 - reference_px2)
    return np.asarray(n * vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T)


def _to_mm(
    calibrated: CalibratedSite,
    targets: Sequence[CalibratedTarget],
    rows: Sequence[slice],
    motion: Pose,
) -> FloatArray:
    """(m, m) by inv(B~) of each, as the camera is turned."""
    whole = np.eye(rows[-1].stop)
    for target, place in zip(targets, rows, strict=True):
        shift = slice(place.start, place.start + 2)
        whole[shift, shift] = np.linalg.inv(turned_B(calibrated, target, motion))
    return whole


def _own_movement(
    site: Site, targets: Sequence[CalibratedTarget], rows: Sequence[slice]
) -> FloatArray:
    stable_mm = {extra.name: extra.stable_mm for extra in site.extra_targets}
    own_mm = np.zeros(rows[-1].stop)
    for target, place in zip(targets, rows, strict=True):
        if target.is_fixed:
            own_mm[place.start : place.start + 2] = stable_mm.get(target.name, 0.0)
    return own_mm


def _keep(covariance: FloatArray) -> FloatArray:
    """(2, m): the main target's shift less what the fixed ones let expect of its error."""
    if len(covariance) == 2:
        return np.eye(2)
    gain = np.linalg.solve(covariance[2:, 2:], covariance[2:, :2]).T
    return np.concatenate([np.eye(2), -gain], axis=1)


def _image_input(name: str, px2: FloatArray, keep: FloatArray, scale: float, dof: float) -> Input:
    mm2 = keep @ px2 @ keep.T
    u_px = scale * math.sqrt(float(np.trace(mm2)) / 2.0)
    return Input(name, "A", "normal", "px", mm2, max(dof, 1.0), u_px)


def _calibration_inputs(
    site: Site, calibrated: CalibratedSite, sensitivities: Sensitivities, keep: FloatArray
) -> list[Input]:
    """The adjusted quantities, each with what it does to row and reference alike taken together.

    An error of lens or board moves the reference's pose and the row's; what is left of the
    reference is its own noise.
    """
    posterior = calibrated.posterior
    view = expected_view(calibrated, site.sub, calibrated.reference_pose)
    lens, corners = sensitivity_through_pose(
        calibrated.lens,
        calibrated.reference_pose,
        calibrated.corners_mm,
        view,
        view.whitening(),
        np.eye(6),
    )
    everywhere = np.zeros((6, *posterior.corners.shape[:2]))
    everywhere[:, view.index] = corners
    reference_by_lens = lens @ posterior.lens
    reference_by_board = np.einsum("kca,car->kr", everywhere, posterior.corners)
    seen = np.einsum(
        "kca,car->kr", sensitivities.by_corners, posterior.corners[sensitivities.index]
    )
    through, models = sensitivities.by_reference, sensitivities.by_model
    discs = np.einsum("kca,car->kr", sensitivities.by_discs, posterior.discs)
    parts = {
        "lens of the sub-camera": sensitivities.by_lens @ posterior.lens
        + through @ reference_by_lens,
        "print and flatness of the board": seen + through @ reference_by_board,
        "reference: noise of the board's pose": through
        @ (posterior.reference - reference_by_lens - reference_by_board),
        "reference: places of the discs": discs,
    }
    names = (
        {
            "rotation between the cameras": slice(0, 3),
            "offset between the cameras": slice(3, 6),
            "distance and scale of the main target": slice(6, 8),
        }
        if models.shape[1] == 8
        else {"the nine parameters": slice(0, 9)}
    )
    parts |= {name: models[:, at] @ posterior.model[at] for name, at in names.items()}
    found = []
    for name, factor in parts.items():
        mm = keep @ factor
        evaluation = "A, B" if "between" in name or "distance" in name else "A"
        found.append(Input(name, evaluation, "normal", "mm", mm @ mm.T, factor_mm=mm))
    return found


def _stability_inputs(site: Site, terms: Sequence[Term], effects: FloatArray) -> list[Input]:
    """What may have changed since the reference; effects (2, 6) mm by the state."""
    whole = len(terms) == len(_BUDGET_KEYS)
    found = []
    for number, term in enumerate(terms):
        mm2 = effects @ term.covariance @ effects.T
        key, unit = _BUDGET_KEYS[number] if whole else ("", "mm")
        u = float(getattr(site.stability, key)) if key else None
        found.append(Input(term.name, "B", "normal", unit, mm2, _estimated(), u))
    return found
