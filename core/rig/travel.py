"""How the main camera has moved across its line of sight between two references.

A fixed target that both show says how the main image has shifted and turned. A rig that pivots
about its mount moves sideways as it turns: how much, its rows show, and that is carried over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.geometry.pose import Pose, skew_matrix
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import predict_shift_of, turn_and_scale_of
from core.rig.rigid import Rig

IMAGE = 3
"""What a fixed target shows of a motion: its shift (2, px) and its turn (rad)."""


@dataclass(frozen=True, slots=True)
class Travel:
    """How the main camera has moved across its line of sight between two references."""

    mm: FloatArray
    """(2,) along its x and y, as it turns points: `T_CM2_CM1`."""
    sigma_mm: float


def travel_by(old: CalibratedSite, motion: Pose, sigma_mm: float) -> Travel | None:
    """What a rig motion `T_CS2_CS1` since the old reference says; None without a rigid model."""
    if not isinstance(old.model, Rig):
        return None
    T_CM_CS = old.model.T_CM_CS
    T_CM2_CM1 = T_CM_CS.compose(motion).compose(T_CM_CS.inverse())
    return Travel(T_CM2_CM1.t_mm[:2], sigma_mm)


def motion_effects(old: CalibratedSite, target: CalibratedTarget) -> FloatArray | None:
    """(5, 6): what a small rig motion (rotation vector, translation) does; None without a Rig.

    To the image of a fixed target: shift (2, px) and turn (rad); and to the main camera: its
    travel (2, mm) as in `Travel`.
    """
    if not isinstance(old.model, Rig):
        return None
    which = np.flatnonzero(np.isfinite(target.reference_px).all(axis=1))
    by_motion = predict_shift_of(old, target, which, Pose.identity()).by_motion
    T_CM_CS = old.model.T_CM_CS
    R, t_mm = T_CM_CS.R, T_CM_CS.t_mm
    travel = np.concatenate([skew_matrix(t_mm) @ R, R], axis=1)[:2]
    return np.concatenate([_image(target.reference_px[which], by_motion), travel])


def image_between(old: CalibratedTarget, new: CalibratedTarget) -> FloatArray:
    """(3,) shift (px) and turn (rad) of a target's image between two references."""
    both = np.isfinite(old.reference_px).all(axis=1) & np.isfinite(new.reference_px).all(axis=1)
    before, after = old.reference_px[both], new.reference_px[both]
    return _image(before, (after - before)[:, :, None])[:, 0]


def _image(points_px: FloatArray, moved: FloatArray) -> FloatArray:
    """(3, m) mean shift and turn of points (n, 2) that have moved (n, 2, m)."""
    weights = np.full(len(points_px), 1.0 / len(points_px))
    turn = np.einsum("ka,kam->m", turn_and_scale_of(weights, points_px)[0], moved)
    return np.concatenate([moved.mean(axis=0), turn[None]])
