"""False displacement predicted from the rig's motion, and removed (Eq. 15 and 20)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray
from core.checkerboard.resection import BoardPose, BoardView, robust_weights
from core.discs.disc_finder import MIN_DISCS, Discs
from core.errors import TargetNotFoundError
from core.results import Displacement, RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.propagation import DISC_FLOOR_PX, predict_shift, shift_sensitivities
from core.rig.rigid import motion_by_pose

AFFINE_LIMIT_PX = 1.0
"""Of Eq. 5: the paper's own limit."""
_CLEAN_MARGIN = 0.04
"""A disc is clean whose explained share is so near to the best one's. Insensitive."""
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
    """rms of the discs about their common shift."""


def choose_discs(calibrated: CalibratedSite, discs: Discs) -> IntArray:
    """Indices of the discs to use: seen in the reference too, the clean ones if three are.

    Raises TargetNotFoundError if fewer than three are left.
    """
    common = discs.found & np.isfinite(calibrated.reference_discs_px).all(axis=1)
    clean = common & (discs.explained_fraction > discs.explained_fraction.max() - _CLEAN_MARGIN)
    chosen = clean if clean.sum() >= MIN_DISCS else common
    if chosen.sum() < MIN_DISCS:
        msg = f"main target: {int(chosen.sum())} of the reference's discs found, 3 are needed"
        raise TargetNotFoundError(msg)
    return np.nonzero(chosen)[0]


def _common_shift(miss_px: FloatArray, which: IntArray) -> tuple[FloatArray, CommonShift]:
    """Robust mean (2,) of the discs' shifts (k, 2)."""
    middle = np.median(miss_px, axis=0)
    away = np.hypot(*(miss_px - middle).T)
    scale = max(float(np.median(away)), _LEAST_SCATTER_PX)
    weights = robust_weights(away / scale)
    weights = weights / weights.sum()
    mean = weights @ miss_px
    squares = ((miss_px - mean) ** 2).sum(axis=1) / 2.0
    return mean, CommonShift(which, weights, float(np.sqrt(weights @ squares)))


def raw_displacement(calibrated: CalibratedSite, discs: Discs) -> tuple[Displacement, CommonShift]:
    """Displacement by the main camera alone: inv(B~) of the discs' common shift."""
    which = choose_discs(calibrated, discs)
    miss = discs.points_px[which] - calibrated.reference_discs_px[which]
    mean, shift = _common_shift(miss, which)
    reference_px2 = _reference_noise(calibrated, shift)
    return _displacement(
        calibrated, mean, _disc_noise(discs, shift, reference_px2) + reference_px2, reference_px2
    ), shift


def _disc_noise(discs: Discs, shift: CommonShift, reference_px2: FloatArray) -> FloatArray:
    """Covariance (2, 2) px^2 of the common shift from this image: as predicted, or as they scatter.

    What the reference's noise makes them scatter does not count.
    """
    each = discs.covariance_px2[shift.which] + DISC_FLOOR_PX**2 * np.eye(2)
    predicted = np.einsum("k,kab->ab", shift.weights**2, each)
    spread = shift.residual_px**2 / max(len(shift.which) - 1, 1)
    excess = spread - np.trace(predicted + reference_px2) / 2.0
    return np.asarray(predicted + max(0.0, excess) * np.eye(2))


def _reference_noise(calibrated: CalibratedSite, shift: CommonShift) -> FloatArray:
    """Covariance (2, 2) px^2 of the common shift from the discs' places in the reference."""
    factor = np.einsum("k,kar->ar", shift.weights, calibrated.posterior.discs[shift.which])
    return np.asarray(factor @ factor.T)


def _displacement(
    calibrated: CalibratedSite,
    shift_px: FloatArray,
    covariance_px2: FloatArray,
    shared_px2: FloatArray,
) -> Displacement:
    to_mm = np.linalg.inv(calibrated.B)
    return Displacement(
        to_mm @ shift_px, to_mm @ covariance_px2 @ to_mm.T, to_mm @ shared_px2 @ to_mm.T
    )


def corrected_displacement(
    calibrated: CalibratedSite, discs: Discs, board: BoardPose, view: BoardView
) -> tuple[Displacement, CommonShift]:
    """Displacement with the false shift removed, Eq. 20: inv(B~) (u_j - u_false_j).

    Its covariance comes from the discs, from this frame's pose, and from the calibration, whose
    lens, board and reference have largely the same effect on all frames and so cancel.
    """
    which = choose_discs(calibrated, discs)
    reference_px = calibrated.reference_discs_px[which]
    motion = board.pose.compose(calibrated.reference_pose.inverse())
    prediction = predict_shift(calibrated.model, reference_px, motion)
    miss = discs.points_px[which] - reference_px - prediction.shift_px
    mean, shift = _common_shift(miss, which)
    root = view.whitening() * np.sqrt(board.weights)[:, None, None]
    sensitivities, by_pose = shift_sensitivities(
        calibrated, prediction, which, shift.weights, board.pose, view, root
    )
    calibration_px2 = sensitivities.covariance(calibrated.posterior)
    covariance_px2 = (
        _disc_noise(discs, shift, _reference_noise(calibrated, shift))
        + by_pose @ board.covariance @ by_pose.T
        + calibration_px2
    )
    return _displacement(calibrated, mean, covariance_px2, calibration_px2), shift
