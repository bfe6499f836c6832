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
_FAMILIAR = 3.0
"""Spreads of the rows' images, within which a new one must lie to be believed."""
_LEAST_FREEDOM = 0.1
"""Of a row: what it alone decides is not divided by less."""


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


@dataclass(frozen=True, slots=True)
class TravelByTurn:
    """Travel by the image of a fixed target, along a straight line through rows."""

    mm: FloatArray
    """(2,) for the turn asked for."""
    sigma_mm: FloatArray
    """(2,) of it, by what is not known of the line."""
    missed_mm: FloatArray
    """(n, 2) what each row misses of the line through the others."""


def travel_by_turn(
    images: FloatArray, travels_mm: FloatArray, turned: FloatArray
) -> TravelByTurn | None:
    """How far a rig moves as a fixed target's image moves by `turned` (3,): least squares.

    images (n, 3) as `image_between`, travels_mm (n, 2). None where the rows' images do not spread,
    or not far enough: a camera that was replaced, or a lens, shifts the image by more.
    """
    spread = images.std(axis=0, ddof=1)
    if not (np.abs(turned) < _FAMILIAR * spread).all():
        return None
    design = np.column_stack([np.ones(len(images)), (images - images.mean(axis=0)) / spread])
    step = np.concatenate([[0.0], turned / spread])
    inverse = np.linalg.pinv(design.T @ design)
    slopes = inverse @ design.T @ travels_mm
    leverage = np.einsum("ni,ij,nj->n", design, inverse, design)
    missed_mm = (travels_mm - design @ slopes) / np.maximum(1.0 - leverage, _LEAST_FREEDOM)[:, None]
    sigma_mm = np.sqrt(step @ inverse @ step) * missed_mm.std(axis=0)
    return TravelByTurn(step @ slopes, sigma_mm, missed_mm)
