"""False displacement predicted from the rig's motion, and removed (Eq. 15 and 20)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from core.arrays import FloatArray, IntArray
from core.checkerboard.resection import BoardPose, BoardView, robust_weights
from core.discs.disc_finder import MIN_DISCS, Discs
from core.errors import TargetNotFoundError
from core.results import Displacement, RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import (
    DiscCombination,
    block_diagonal,
    mean_of,
    predict_shift_of,
    shift_sensitivities,
    turn_and_scale_of,
    turned_B,
)
from core.rig.rigid import motion_by_pose

AFFINE_LIMIT_PX = 1.0
"""Of Eq. 5: the paper's own limit."""
_CLEAN_MARGIN = 0.04
"""A disc is clean whose explained share is so near to the best one's. Insensitive."""
PRIOR_FREEDOM = 2
"""Degrees of freedom that the predicted noise of discs counts as: those of one disc. Chosen."""
_LEAST_SCATTER_PX = 0.01
"""Of the discs about their median, for robust weights: a few discs may lie together by chance."""


def affine(centres_mm: FloatArray, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Affine camera [B~, b] of Eq. 7-8 by least squares: (2, 2) px/mm and (2,) px.

    >>> centres_mm = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0]])
    >>> B, b = affine(centres_mm, centres_mm * [12.5, -12.5] + [960.0, 600.0])
    >>> B.diagonal().round(6).tolist(), b.round(6).tolist()
    ([12.5, -12.5], [960.0, 600.0])
    """
    design = np.concatenate([centres_mm, np.ones((len(centres_mm), 1))], axis=1)
    solution = np.linalg.lstsq(design, points_px, rcond=None)[0]
    return solution[:2].T, solution[2]


def affine_error_px(distance_mm: float, axial_motion_mm: float, off_axis_px: float) -> float:
    """Eq. 5: |dz / d0 (x - x0)|, the error of the affine camera; it should stay below 1 px.

    >>> round(affine_error_px(distance_mm=11000.0, axial_motion_mm=10.0, off_axis_px=900.0), 3)
    0.818
    """
    return abs(axial_motion_mm / distance_mm) * off_axis_px


def rig_motion(calibrated: CalibratedSite, board: BoardPose) -> RigMotion:
    """`T_CSj_CS1 = T_CSj_WS inv(T_CS1_WS)`, Eq. 12; the covariance is this frame's alone."""
    motion = board.pose.compose(calibrated.reference_pose.inverse())
    by_pose = motion_by_pose(motion, calibrated.reference_pose)
    return RigMotion(motion.rotation_rad, motion.t_mm, by_pose @ board.covariance @ by_pose.T)


@dataclass(frozen=True, slots=True)
class CommonShift:
    """The discs' common shift from their places in the reference."""

    which: IntArray
    """(k,) indices of the discs used."""
    weights: FloatArray
    """(k,) summing to 1."""
    residual_px: float
    """rms of the discs about their common shift and change of scale, which a lens that warms makes.
    A turn that the rig's roll does not explain is in it: the board was turned."""
    scatter_px: float
    """Likewise about their turn, too: what noise and disturbances leave."""


@dataclass(frozen=True, slots=True)
class SeenTarget:
    """A calibrated target, and its discs in an image."""

    target: CalibratedTarget
    discs: Discs


@dataclass(frozen=True, slots=True)
class Shifts:
    """How far targets are from where the rig's motion alone would put them."""

    targets: tuple[CalibratedTarget, ...]
    common: tuple[CommonShift, ...]
    rows: tuple[slice, ...]
    """Of the values below, for each target: mean shift (2, px) and, for a fixed one, its own turn
    (rad) and relative change of scale."""
    values: FloatArray
    """(m,)."""
    covariance: FloatArray
    """(m, m) from the pixels and the calibration."""
    shared: FloatArray
    """(m, m) the part of it that is the same in every frame."""
    B: tuple[FloatArray, ...]
    """(2, 2) px/mm of each target, as the camera is turned now."""
    places_px: tuple[FloatArray, ...]
    """(2,) where the discs of each target are now, in the mean."""

    @property
    def to_mm(self) -> FloatArray:
        """(m, m) that brings the shifts to mm, by inv(B~) of each."""
        whole = np.eye(len(self.values))
        for B, rows in zip(self.B, self.rows, strict=True):
            shift = slice(rows.start, rows.start + 2)
            whole[shift, shift] = np.linalg.inv(B)
        return whole


def choose_discs(target: CalibratedTarget, discs: Discs) -> IntArray:
    """Indices of the discs to use: seen in the reference too, the clean ones if three are.

    Raises TargetNotFoundError if fewer than three are left.
    """
    common = discs.found & np.isfinite(target.reference_px).all(axis=1)
    clean = common & (discs.explained_fraction > discs.explained_fraction.max() - _CLEAN_MARGIN)
    chosen = clean if clean.sum() >= MIN_DISCS else common
    if chosen.sum() < MIN_DISCS:
        msg = (
            f"{target.name} target: {int(chosen.sum())} of the reference's discs found, "
            f"{MIN_DISCS} are needed"
        )
        raise TargetNotFoundError(msg)
    return np.nonzero(chosen)[0]


def _common_shift(
    miss_px: FloatArray, which: IntArray, points_px: FloatArray
) -> tuple[FloatArray, CommonShift]:
    """Robust mean (2,) of the discs' shifts (k, 2)."""
    middle = np.median(miss_px, axis=0)
    away = np.hypot(*(miss_px - middle).T)
    scale = max(float(np.median(away)), _LEAST_SCATTER_PX)
    weights = robust_weights(away / scale)
    weights = weights / weights.sum()
    mean = weights @ miss_px
    turn, growth = np.einsum("mka,ka->m", turn_and_scale_of(weights, points_px), miss_px)
    x, y = (points_px - weights @ points_px).T
    left = miss_px - mean - growth * np.stack([x, y], axis=1)
    turned = turn * np.stack([-y, x], axis=1)

    def rms(miss: FloatArray) -> float:
        return float(np.sqrt(weights @ (miss**2).sum(axis=1) / 2.0))

    return mean, CommonShift(which, weights, rms(left), rms(left - turned))


def raw_displacement(
    calibrated: CalibratedSite, seen: SeenTarget
) -> tuple[Displacement, CommonShift]:
    """Displacement by the main camera alone: inv(B~) of the discs' common shift.

    Raises TargetNotFoundError if fewer than three discs are seen here and in the reference.
    """
    target, discs = seen.target, seen.discs
    which = choose_discs(target, discs)
    miss = discs.points_px[which] - target.reference_px[which]
    mean, shift = _common_shift(miss, which, target.reference_px[which])
    reference_px2 = _reference_noise(calibrated, target, shift)
    own_px2 = _disc_noise(discs, shift, reference_px2, mean_of(shift.weights))
    covariance_px2 = own_px2 + reference_px2
    to_mm = np.linalg.inv(target.B)
    return Displacement(
        to_mm @ mean, to_mm @ covariance_px2 @ to_mm.T, to_mm @ reference_px2 @ to_mm.T
    ), shift


def _disc_noise(
    discs: Discs, shift: CommonShift, reference_px2: FloatArray, sums: FloatArray
) -> FloatArray:
    """Covariance (m, m) of sums over the discs from this image: as predicted and as they scatter.

    What the reference's noise makes them scatter does not count.
    """
    each = discs.covariance_px2[shift.which]
    predicted = np.einsum("k,kab->ab", shift.weights**2, each)
    n = len(shift.which)
    spread_px2 = shift.scatter_px**2 / (n - 2)
    share = noise_share(
        np.trace(predicted) / 2.0, np.trace(reference_px2) / 2.0, spread_px2, 2 * (n - 2)
    )
    return np.asarray(share * np.einsum("mka,kab,lkb->ml", sums, each, sums))


def noise_share(predicted: float, reference: float, spread: float, freedom: int) -> float:
    """By what the predicted variance of a mean of discs is to be multiplied, as they scatter.

    All as variances of the mean. The most probable share: the discs' scatter has the variance
    share x predicted + reference, and what was predicted counts as one more disc with just this
    scatter. Where the scatter is as predicted that is 1. To take a larger scatter as it is, and
    none that is smaller, would make the noise too large in the mean.
    """
    if predicted <= 0.0:
        return 1.0

    def slope(share: float) -> float:
        whole = share * predicted + reference
        return PRIOR_FREEDOM * (share - 1.0) * whole**2 + freedom * predicted * share**2 * (
            whole - spread
        )

    return float(scipy.optimize.brentq(slope, 1e-9, 1.0 + spread / predicted, rtol=1e-6))


def _reference_noise(
    calibrated: CalibratedSite, target: CalibratedTarget, shift: CommonShift
) -> FloatArray:
    """Covariance (2, 2) px^2 of the common shift from the discs' places in the reference."""
    if target.role is not None:
        return np.asarray(shift.weights**2 @ target.reference_px2[shift.which] * np.eye(2))
    factor = np.einsum("k,kar->ar", shift.weights, calibrated.posterior.discs[shift.which])
    return np.asarray(factor @ factor.T)


def remaining_shifts(
    calibrated: CalibratedSite, seen: Sequence[SeenTarget], board: BoardPose, view: BoardView
) -> Shifts:
    """Shifts of the targets with the false shift removed, u_j - u_false_j of Eq. 20.

    Their covariance comes from the discs, from this frame's pose, and from the calibration, whose
    lens, board and reference have largely the same effect on all frames and on all targets.
    Raises TargetNotFoundError if fewer than three discs of one are seen.
    """
    motion = board.pose.compose(calibrated.reference_pose.inverse())
    commons, combinations, noises, values, places_px = [], [], [], [], []
    for one in seen:
        target, discs = one.target, one.discs
        which = choose_discs(target, discs)
        prediction = predict_shift_of(calibrated, target, which, motion)
        miss = discs.points_px[which] - target.reference_px[which] - prediction.shift_px
        common = _common_shift(miss, which, target.reference_px[which])[1]
        sums = mean_of(common.weights)
        if target.is_fixed:
            turn = turn_and_scale_of(common.weights, target.reference_px[which])
            sums = np.concatenate([sums, turn])
        combination = DiscCombination(target, which, sums, prediction)
        reference_px2 = _reference_noise(calibrated, target, common)
        commons.append(common)
        combinations.append(combination)
        values.append(combination.of(miss))
        noises.append(_disc_noise(discs, common, reference_px2, sums))
        places_px.append(common.weights @ discs.points_px[which])
    root = view.whitening() * np.sqrt(board.weights)[:, None, None]
    sensitivities, by_pose = shift_sensitivities(calibrated, combinations, board.pose, view, root)
    shared = sensitivities.covariance(calibrated.posterior)
    own = block_diagonal(noises) + by_pose @ board.covariance @ by_pose.T
    ends = np.cumsum([len(value) for value in values]).tolist()
    rows = tuple(slice(end - len(value), end) for end, value in zip(ends, values, strict=True))
    targets = tuple(one.target for one in seen)
    return Shifts(
        targets,
        tuple(commons),
        rows,
        np.concatenate(values),
        own + shared,
        shared,
        tuple(turned_B(calibrated, target, motion) for target in targets),
        tuple(places_px),
    )


def corrected_displacement(
    calibrated: CalibratedSite, discs: Discs, board: BoardPose, view: BoardView
) -> tuple[Displacement, CommonShift]:
    """Displacement of the main target without the false shift, Eq. 20: inv(B~) (u_j - u_false_j).

    By the pixels and the calibration alone. Raises TargetNotFoundError.
    """
    seen = [SeenTarget(calibrated.main_target, discs)]
    shifts = remaining_shifts(calibrated, seen, board, view)
    to_mm = shifts.to_mm
    displacement = Displacement(
        to_mm @ shifts.values,
        to_mm @ shifts.covariance @ to_mm.T,
        to_mm @ shifts.shared @ to_mm.T,
    )
    return displacement, shifts.common[0]
