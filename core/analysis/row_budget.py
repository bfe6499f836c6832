"""How the uncertainty of one row splits by cause.

Each input's part of the covariance of the displacement is carried through the same derivatives as
in `core.rig.compensation` and `core.rig.closure`, so that all parts together are what the row
carries.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from core.analysis.budget import RELIABILITY, Budget, BudgetModel, DatumPart, Input, RowState
from core.analysis.datum_budget import by_reference_input, link_of, places_root, rest_input
from core.arrays import FloatArray
from core.checkerboard.resection import BoardView
from core.geometry.pose import Pose
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
_REFERENCE_POSE = "reference: noise of the board's pose"
_REFERENCE_PLACES = "reference: places of the discs"
_FURTHER_PLACES = "reference: places of the fixed targets' discs"
_LEAST_SHARE, _MOST_SHARE = 1e-4, 4.0
"""Of the noise that the raw displacement shows, for that of the corrected one's discs."""


def row_budget(
    site: Site,
    calibrated: CalibratedSite,
    row: RowState,
    terms: Sequence[Term],
    datum: DatumPart | None = None,
) -> Budget:
    """Split what a row's sigma is made of by cause; terms are `stability_terms` at the row.

    The corners are taken to be those that the pose puts into the image.
    """
    pose = row.motion.compose(calibrated.reference_pose)
    view = expected_view(calibrated, site.sub, pose)
    errors = _value_errors(site, calibrated, row, terms, pose, view)
    share = errors.disc_share(row.image_mm2)
    keep = errors.keep(share)
    parts = _calibration_parts(site, calibrated, errors.sensitivities)
    names = [one.target.name for one in errors.combinations]
    of_reference = parts[_REFERENCE_POSE] + parts[_REFERENCE_PLACES]
    linked = link_of(datum, names, errors.to_mm, of_reference)
    inputs = (
        _discs_input(errors.discs(share), keep, main_scale(calibrated.B), errors.disc_count),
        _pose_input(errors.corners, keep, row.corners or len(view.index)),
        *_calibration_inputs(parts, errors.places_root_px, keep),
        *([] if datum is None else [by_reference_input(linked, errors.places_root_px)]),
        _unmodelled_input(calibrated, errors, keep),
        *_stability_inputs(site, terms, keep @ errors.effects),
        *_fixed_target_inputs(errors, keep),
        *([] if datum is None else [rest_input(linked)]),
    )
    model = BudgetModel(
        site=site,
        calibrated=calibrated,
        row=row,
        targets=tuple(one.target for one in errors.combinations),
        combinations=errors.combinations,
        disc_px2=tuple(share * px2 for px2 in errors.one_disc_px2),
        view=view,
        terms=tuple(terms),
        keep_mm=keep,
        own_mm=errors.own_mm,
        to_mm=errors.to_mm,
        rows=errors.rows,
        places_px=errors.places_px,
        datum_mm2=linked.rest_mm2,
        datum_by_calibration_mm=linked.by_calibration_mm,
        datum_by_places_mm=linked.by_places_mm,
    )
    return Budget(inputs, main_scale(calibrated.B), model)


@dataclass(frozen=True, slots=True)
class _ValueErrors:
    """How the m values of the targets err: the shift of each, the turn and scale of fixed ones."""

    combinations: tuple[DiscCombination, ...]
    rows: tuple[slice, ...]
    """Of each target among the values."""
    places_px: tuple[FloatArray, ...]
    """(2,) where the discs of each target are in the row, in the mean."""
    one_disc_px2: tuple[FloatArray, ...]
    """(2, 2) of a disc of each target as the raw displacement has it: at most."""
    corners: FloatArray
    """(m, m) of the board's pose in this frame."""
    calibration: FloatArray
    """(m, m)."""
    sensitivities: Sensitivities
    """To what was calibrated."""
    places_root_px: FloatArray
    """(m, q) root of the covariance of further targets' places in the reference."""
    effects: FloatArray
    """(m, 6) of the state that `core.rig.stability` has terms for."""
    stability: FloatArray
    """(m, m)."""
    to_mm: FloatArray
    """(m, m)."""
    own_mm: FloatArray
    """(m,) 1 sigma of fixed targets' own movement."""

    @property
    def disc_count(self) -> int:
        """Of the main target."""
        return len(self.combinations[0].which)

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
        whole = self.discs(share) + self.corners + self.calibration + self.stability
        covariance = self.to_mm @ whole @ self.to_mm.T + np.diag(self.own_mm**2)
        return np.asarray(_keep(covariance) @ self.to_mm)

    def disc_share(self, image_mm2: FloatArray | None) -> float:
        """By what the noise that raw discs show is to be multiplied for the row's image part.

        Discs scatter a little otherwise once the rig's motion is off.
        """
        if image_mm2 is None:
            return 1.0
        others = self.corners + self.calibration

        def excess(log_share: float) -> float:
            share = math.exp(log_share)
            keep = self.keep(share)
            return float(np.trace(keep @ (self.discs(share) + others) @ keep.T - image_mm2))

        least, most = math.log(_LEAST_SHARE), math.log(_MOST_SHARE)
        if excess(most) <= 0.0:
            return _MOST_SHARE
        if excess(least) >= 0.0:
            return _LEAST_SHARE
        return math.exp(float(optimize.brentq(excess, least, most, xtol=1e-3)))


def _value_errors(
    site: Site,
    calibrated: CalibratedSite,
    row: RowState,
    terms: Sequence[Term],
    pose: Pose,
    view: BoardView,
) -> _ValueErrors:
    targets = [
        one
        for one in (calibrated.main_target, *calibrated.further)
        if one.name == MAIN or (one.name in row.believed and one.name in row.raw_mm2)
    ]
    combinations, rows = _combinations(calibrated, targets, row.motion)
    sensitivities, _ = shift_sensitivities(calibrated, combinations, pose, view, view.whitening())
    by_motion = np.concatenate([c.of(c.prediction.by_motion) for c in combinations])
    places_px = tuple(one.middle_px + one.B @ row.raw_mm[one.name] for one in targets)
    centre_px, distance_mm = site.main.centre_px, site.main_target.distance_mm
    effects = np.concatenate(
        [
            state_effects(one, place_px, centre_px, distance_mm)[: s.stop - s.start]
            for one, place_px, s in zip(targets, places_px, rows, strict=True)
        ]
    )
    none = np.zeros((len(effects), len(effects)))
    return _ValueErrors(
        combinations=tuple(combinations),
        rows=tuple(rows),
        places_px=places_px,
        one_disc_px2=tuple(_one_disc(calibrated, c, row) for c in combinations),
        corners=by_motion @ row.motion_covariance @ by_motion.T,
        calibration=sensitivities.covariance(calibrated.posterior),
        sensitivities=sensitivities,
        places_root_px=places_root(combinations),
        effects=effects,
        stability=sum((effects @ t.covariance @ effects.T for t in terms), none),
        to_mm=_to_mm(calibrated, targets, rows, row.motion),
        own_mm=_own_movement(site, targets, rows),
    )


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


def _discs_input(px2: FloatArray, keep: FloatArray, scale: float, discs: int) -> Input:
    mm2 = keep @ px2 @ keep.T
    u_px = scale * math.sqrt(float(np.trace(mm2)) / 2.0)
    freedom = max(2.0 * discs - 2.0, 1.0)
    return Input("discs in the main image", "A", "normal", "px", mm2, freedom, u_px)


def _pose_input(corners: FloatArray, keep: FloatArray, count: int) -> Input:
    name = "pose of the board, from its corners in the sub image"
    return Input(name, "A", "normal", "mm", keep @ corners @ keep.T, max(2.0 * count - 6.0, 1.0))


def _calibration_parts(
    site: Site, calibrated: CalibratedSite, sensitivities: Sensitivities
) -> dict[str, FloatArray]:
    """(m, r) of each adjusted quantity: what it does to row and reference alike taken together.

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
        _REFERENCE_POSE: through @ (posterior.reference - reference_by_lens - reference_by_board),
        _REFERENCE_PLACES: discs,
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
    return parts


def _calibration_inputs(
    parts: Mapping[str, FloatArray], places_root_px: FloatArray, keep: FloatArray
) -> list[Input]:
    """The adjusted quantities, and behind their columns the fixed targets' discs' places."""
    found, more = [], places_root_px.shape[1]
    for name, factor in parts.items():
        mm = np.pad(keep @ factor, ((0, 0), (0, more)))
        evaluation = "A, B" if "between" in name or "distance" in name else "A"
        found.append(Input(name, evaluation, "normal", "mm", mm @ mm.T, factor_mm=mm))
    if more:
        mm = np.pad(-keep @ places_root_px, ((0, 0), (factor.shape[1], 0)))
        found.append(Input(_FURTHER_PLACES, "A", "normal", "mm", mm @ mm.T, factor_mm=mm))
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


def _unmodelled_input(calibrated: CalibratedSite, errors: _ValueErrors, keep: FloatArray) -> Input:
    name = "corners of the board, each by itself; plainness of the main camera's model"
    root = errors.places_root_px
    own = errors.sensitivities.own(calibrated.posterior) - root @ root.T
    return Input(name, "B", "normal", "mm", keep @ own @ keep.T)


def _fixed_target_inputs(errors: _ValueErrors, keep: FloatArray) -> list[Input]:
    """What fixed targets are taken to move by themselves, where any is."""
    if not errors.own_mm.any():
        return []
    left = keep @ np.linalg.inv(errors.to_mm)
    covariance = left @ np.diag(errors.own_mm**2) @ left.T
    name = "fixed targets' own movement"
    return [Input(name, "B", "normal", "mm", covariance, _estimated())]
