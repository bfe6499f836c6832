"""How wrong the targets' places at a calibration's reference are, by its own two images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import (
    DiscCombination,
    expected_view,
    mean_of,
    predict_shift_of,
    shift_sensitivities,
    turn_and_scale_of,
)
from core.rig.reference_errors import ReferenceErrors
from core.site import CameraGeometry


def errors_at_reference(calibrated: CalibratedSite, camera: CameraGeometry) -> ReferenceErrors:
    """Errors of the targets' places at the reference by the noise of its own two images.

    Taken where the rig has not moved: lens, board and rig then have no effect, and what a row
    shares with the reference is the reference's own noise. camera is the sub-camera. An adjusted
    value has the same covariance with any unbiased one from the same images as with itself (Gauss
    and Markov), so that this holds too for a link that measured the reference by itself.
    """
    targets = [calibrated.main_target, *calibrated.further]
    combinations = [_combination(calibrated, target) for target in targets]
    pose = calibrated.reference_pose
    view = expected_view(calibrated, camera, pose)
    sensitivities, _ = shift_sensitivities(calibrated, combinations, pose, view, view.whitening())
    factor_px = sensitivities.propagate(calibrated.posterior)
    sizes = [len(combination.sums) for combination in combinations]
    to_mm = _to_mm(combinations, sizes)
    covariance = to_mm @ (factor_px @ factor_px.T + sensitivities.floor) @ to_mm.T
    names = tuple(target.name for target in targets)
    return ReferenceErrors(names, tuple(target.is_fixed for target in targets), covariance)


def _combination(calibrated: CalibratedSite, target: CalibratedTarget) -> DiscCombination:
    which = np.nonzero(np.isfinite(target.reference_px).all(axis=1))[0]
    weights = np.full(len(which), 1.0 / len(which))
    turn = turn_and_scale_of(weights, target.reference_px[which])
    sums = np.concatenate([mean_of(weights), turn])
    prediction = predict_shift_of(calibrated, target, which, Pose.identity())
    return DiscCombination(target, which, sums, prediction)


def _to_mm(combinations: Sequence[DiscCombination], sizes: Sequence[int]) -> FloatArray:
    """(m, m) that brings the shifts to mm."""
    whole = np.eye(sum(sizes))
    for combination, end in zip(combinations, np.cumsum(sizes), strict=True):
        start = int(end) - len(combination.sums)
        shift = slice(start, start + 2)
        whole[shift, shift] = np.linalg.inv(combination.target.B)
    return whole
