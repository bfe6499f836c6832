"""What the calibration's motions determine, and how far a correction can be trusted in mm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.compensation import predict_shift
from core.errors import NotObservableError
from core.paper import PaperModel
from core.pose import Pose
from core.rig import Rig, motion_by_reference
from core.setup import Setup
from core.site import FloatArray, QualityLimits

MIN_RIG_VIEWS = 4
_MIN_TURN_RAD = 2e-4
_MIN_RATIO = 0.05
_AXES = (
    "rotation about x",
    "rotation about y",
    "rotation about z",
    "translation along x",
    "translation along y",
    "translation along z",
)


def require_motion(motions: Sequence[Pose]) -> None:
    """Raise NotObservableError unless the rig was turned about two axes.

    The main camera's scale and its roll about its own axis show only when the rig turns both
    about x (tilt) and about y (pan) of the sub-camera.
    """
    if len(motions) < MIN_RIG_VIEWS:
        msg = (
            f"calibration: {len(motions)} usable rig positions, at least {MIN_RIG_VIEWS} are "
            "needed; move the rig by pan and tilt and take more"
        )
        raise NotObservableError(msg)
    turns = np.array([m.rotation_rad[:2] for m in motions])
    spread, axes = np.linalg.svd(turns / np.sqrt(len(turns)), full_matrices=False)[1:]
    if spread[0] < _MIN_TURN_RAD:
        msg = (
            f"calibration: the rig turned by only {spread[0] * 1e3:.3f} mrad rms about x (tilt) "
            f"and y (pan); turn it by at least {_MIN_TURN_RAD * 1e3:.1f} mrad about both"
        )
        raise NotObservableError(msg)
    if spread[1] < _MIN_RATIO * spread[0] or spread[1] < 0.25 * _MIN_TURN_RAD:
        missing = (
            "tilt (rotation about x)" if abs(axes[1, 0]) > 0.7071 else "pan (rotation about y)"
        )
        if min(abs(axes[1])) > 0.3827:
            missing = "a turn across the one made (pan and tilt always moved together)"
        msg = (
            f"calibration: the motions do not determine the model; missing motion: {missing}; "
            f"the rig turned {spread[0] * 1e3:.3f} mrad rms one way and "
            f"{spread[1] * 1e3:.4f} mrad across it"
        )
        raise NotObservableError(msg)


@dataclass(frozen=True, slots=True)
class DriftError:
    """Predicted 1-sigma error of a correction for one motion of the expected drift."""

    motion: str
    sigma_mm: float


def drift_errors(setup: Setup, limits: QualityLimits) -> tuple[DriftError, ...]:
    """Predicted calibration error (1 sigma, mm, the worse direction) of each drift motion."""
    amounts = [limits.expected_drift_mrad * 1e-3] * 3 + [limits.expected_drift_mm] * 3
    errors = []
    for axis, (name, amount) in enumerate(zip(_AXES, amounts, strict=True)):
        errors.append(DriftError(name, motion_sigma_mm(setup, _along(axis, amount))))
    return tuple(errors)


def motion_sigma_mm(setup: Setup, motion: Pose) -> float:
    """1 sigma of a correction from the calibration alone, mm, the worse direction.

    Model and reference are propagated; the lens and the board act on each frame's pose and are
    part of a measurement's own sigma.
    """
    return _sigma_mm(setup, motion, setup.model_covariance)


def _sigma_mm(setup: Setup, motion: Pose, covariance: FloatArray) -> float:
    jacobian = _change_jacobian(setup, motion)
    to_mm = np.linalg.inv(setup.B) @ jacobian
    return float(np.sqrt(np.linalg.eigvalsh(to_mm @ covariance @ to_mm.T).max()))


def _change_jacobian(setup: Setup, motion: Pose) -> FloatArray:
    """d(predicted shift for a motion minus that for none) by model and reference pose, (2, m)."""
    reference_px = setup.reference_discs_px[np.isfinite(setup.reference_discs_px).all(axis=1)]
    parts = []
    for T_CSj_CS1 in (motion, Pose.identity()):
        prediction = predict_shift(setup.model, reference_px, T_CSj_CS1)
        by_reference = motion_by_reference(T_CSj_CS1, setup.reference_pose)
        parts.append(
            np.concatenate(
                [
                    prediction.by_model.mean(axis=0),
                    prediction.by_motion.mean(axis=0) @ by_reference,
                ],
                axis=1,
            )
        )
    return np.asarray(parts[0] - parts[1])


_FURTHER: tuple[tuple[str, int, float | None], ...] = (
    ("pan the rig further, by {mrad:.0f} mrad both ways", 1, None),
    ("tilt the rig further, by {mrad:.0f} mrad both ways", 0, None),
    ("roll the rig about the viewing axis, by 10 mrad both ways (a wedge under one side)", 2, 0.01),
    ("slide the rig sideways, by 5 mm both ways", 3, 5.0),
    ("slide the rig up and down, by 5 mm both ways", 4, 5.0),
    ("slide the rig along the viewing axis, by 5 mm both ways", 5, 5.0),
)
"""What to do, the axis it moves along, and how far (rad or mm); None is twice what was made."""
_DISC_NOISE_PX = 0.005
_WORTHWHILE = 0.7


def further_motion(setup: Setup, limits: QualityLimits) -> str | None:
    """Say which further motion would sharpen the worst drift correction most, or None.

    Each candidate is added to the calibration as two positions either way, seen with the
    reference's own pose noise (a Kalman update of model and reference).
    """
    amounts = [limits.expected_drift_mrad * 1e-3] * 3 + [limits.expected_drift_mm] * 3
    drifts = [_along(axis, amount) for axis, amount in enumerate(amounts)]
    covariance = setup.model_covariance
    now = [_sigma_mm(setup, drift, covariance) for drift in drifts]
    turn = 2.0 * setup.levels.max_rotation_rad
    best, words = max(now), ""
    for text, axis, amount in _FURTHER:
        step = turn if amount is None else amount
        updated = _with_positions(setup, covariance, [_along(axis, step), _along(axis, -step)] * 2)
        worst = max(_sigma_mm(setup, drift, updated) for drift in drifts)
        if worst < best:
            best, words = worst, text.format(mrad=turn * 1e3)
    if not words or best > _WORTHWHILE * max(now):
        return None
    return (
        f"to improve most: {words}; the worst of these, {_AXES[int(np.argmax(now))]}, would go "
        f"from {max(now):.3f} mm to about {best:.3f} mm"
    )


def _along(axis: int, amount: float) -> Pose:
    vector = np.zeros(6)
    vector[axis] = amount
    return Pose.from_vectors(vector[:3], vector[3:])


def _with_positions(setup: Setup, covariance: FloatArray, motions: Sequence[Pose]) -> FloatArray:
    """The covariance after the rig has been seen at further positions."""
    middle = setup.reference_discs_px[np.isfinite(setup.reference_discs_px).all(axis=1)]
    still = predict_shift(setup.model, middle, Pose.identity())
    by_pose = still.by_motion.mean(axis=0)
    pose_noise = covariance[-6:, -6:]
    for motion in motions:
        jacobian = _change_jacobian(setup, motion)
        noise = _DISC_NOISE_PX**2 * np.eye(2) + by_pose @ pose_noise @ by_pose.T
        gain = np.linalg.solve(jacobian @ covariance @ jacobian.T + noise, jacobian @ covariance)
        covariance = covariance - covariance @ jacobian.T @ gain
    return covariance


def determined_share(setup: Setup, prior_sigma: FloatArray) -> FloatArray:
    """(8,) how far the views, not the priors, determine each rig parameter: 1 - (post/prior)^2."""
    posterior = np.diag(setup.model_covariance)[: len(prior_sigma)]
    return np.asarray(np.clip(1.0 - posterior / prior_sigma**2, 0.0, 1.0))


def model_sentence(model: Rig | PaperModel) -> str:
    """One sentence on what the fit left open."""
    if isinstance(model, Rig):
        return (
            f"main camera: {model.scale_px_per_mm:.4f} px/mm at {model.depth_mm:.0f} mm, "
            f"turned against the sub-camera by {_angles(model)}"
        )
    return (
        f"paper's nine parameters: {model.null_directions} of 9 directions are not determined by "
        "the motions; corrections of other motions (translation, roll) can be wrong by millimetres"
    )


def _angles(rig: Rig) -> str:
    from_back_to_back = rig.T_CM_CS.R @ np.diag([-1.0, 1.0, -1.0])
    x, y, z = np.degrees(Pose(from_back_to_back, np.zeros(3)).rotation_rad)
    return f"({x:+.3f}, {y:+.3f}, {z:+.3f}) deg from back to back"
