"""What the calibration's motions determine, and how far a correction can be trusted in mm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray
from core.errors import NotObservableError
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.paper import PaperModel
from core.rig.posterior import Posterior
from core.rig.propagation import expected_sensitivities
from core.rig.rigid import Rig
from core.site import QualityLimits, Site

MIN_RIG_VIEWS = 4
"""Five unknowns of the rig show in the images, two a view; so many leave something to check by."""
_MIN_TURN_RAD = 2e-4
"""Turn of the rig, rms: 2.2 mm at 11 m, some twenty times the error of a pose by plain corners."""
_MIN_RATIO, _MIN_ACROSS = 0.05, 0.25
"""Of the turn across the main one: its share of that, and of the least turn."""
_FAR_TURNS, _USUAL_PERCENTILE = 10.0, 75.0
"""Turns beyond so many times this percentile of all are of a distorted image."""
_OBLIQUE = 0.3827
"""Sine of 22.5 degrees: a main direction further than this from both axes is neither pan nor
tilt."""
_DIAGONAL = 0.7071
"""Cosine of 45 degrees: which of pan and tilt a direction is nearer to."""
_FURTHER_FACTOR = 2.0
"""A further pan or tilt is suggested to so many times what was made."""
AXES = (
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
    size = np.hypot(turns[:, 0], turns[:, 1])
    # One distorted image can seem to have turned by far more than the head can.
    turns = turns[size <= _FAR_TURNS * np.percentile(size, _USUAL_PERCENTILE)]
    spread, axes = np.linalg.svd(turns / np.sqrt(len(turns)), full_matrices=False)[1:]
    if spread[0] < _MIN_TURN_RAD:
        msg = (
            f"calibration: the rig turned by only {spread[0] * 1e3:.3f} mrad rms about x (tilt) "
            f"and y (pan); turn it by at least {_MIN_TURN_RAD * 1e3:.1f} mrad about both"
        )
        raise NotObservableError(msg)
    if spread[1] < _MIN_RATIO * spread[0] or spread[1] < _MIN_ACROSS * _MIN_TURN_RAD:
        missing = (
            "tilt (rotation about x)" if abs(axes[1, 0]) > _DIAGONAL else "pan (rotation about y)"
        )
        if min(abs(axes[1])) > _OBLIQUE:
            missing = "a turn across the one made (pan and tilt always moved together)"
        msg = (
            f"calibration: the motions do not determine the model; missing motion: {missing}; "
            f"the rig turned {spread[0] * 1e3:.3f} mrad rms one way and "
            f"{spread[1] * 1e3:.4f} mrad across it"
        )
        raise NotObservableError(msg)


@dataclass(frozen=True, slots=True)
class DriftError:
    """Expected 1-sigma error of a row for one motion of the expected drift."""

    motion: str
    sigma_mm: float
    """As the row will carry it: calibration and image noise."""
    calibration_mm: float
    """The calibration's part of it."""


def drift_motions(limits: QualityLimits) -> tuple[Pose, ...]:
    """`T_CSj_CS1` of the expected drift about and along each axis."""
    amounts = [limits.expected_drift_mrad * 1e-3] * 3 + [limits.expected_drift_mm] * 3
    return tuple(_along(axis, amount) for axis, amount in enumerate(amounts))


def drift_errors(calibrated: CalibratedSite, site: Site) -> tuple[DriftError, ...]:
    """Expected error (1 sigma, mm, the worse direction) of a row for each drift motion."""
    errors = []
    for name, motion in zip(AXES, drift_motions(site.quality), strict=True):
        expected = _expect(calibrated, site, motion)
        errors.append(
            DriftError(
                name, expected.sigma_mm(calibrated), expected.sigma_mm(calibrated, noise=False)
            )
        )
    return tuple(errors)


@dataclass(frozen=True, slots=True)
class _Expected:
    """What a row will be like after a rig motion."""

    jacobian_px: FloatArray
    """(2, r) px, by the posterior's columns."""
    own_px2: FloatArray
    """(2, 2) from the corners' own errors."""
    noise_px2: FloatArray
    """(2, 2) from the row's own images."""

    def sigma_mm(
        self, calibrated: CalibratedSite, knowledge: FloatArray | None = None, *, noise: bool = True
    ) -> float:
        """1 sigma, mm, the worse direction; knowledge (r, r) replaces the identity."""
        inner = self.jacobian_px if knowledge is None else self.jacobian_px @ knowledge
        covariance = inner @ self.jacobian_px.T + self.own_px2
        if noise:
            covariance = covariance + self.noise_px2
        to_mm = np.linalg.inv(calibrated.B)
        return float(np.sqrt(np.linalg.eigvalsh(to_mm @ covariance @ to_mm.T).max()))


def _expect(calibrated: CalibratedSite, site: Site, motion: Pose) -> _Expected:
    sensitivities, noise = expected_sensitivities(calibrated, site.sub, motion)
    return _Expected(
        sensitivities.propagate(calibrated.posterior),
        sensitivities.own(calibrated.posterior),
        noise,
    )


_FURTHER: tuple[tuple[str, int, float | None], ...] = (
    ("pan the rig further, by {mrad:.0f} mrad both ways", 1, None),
    ("tilt the rig further, by {mrad:.0f} mrad both ways", 0, None),
    ("roll the rig about the viewing axis, by 10 mrad both ways (a wedge under one side)", 2, 0.01),
    ("slide the rig sideways, by 5 mm both ways", 3, 5.0),
    ("slide the rig up and down, by 5 mm both ways", 4, 5.0),
    ("slide the rig along the viewing axis, by 5 mm both ways", 5, 5.0),
)
"""What to do, the axis it moves along, and how far (rad or mm); None is twice what was made."""
_WORTHWHILE = 0.85
"""A motion is suggested if it leaves no more than this of the worst sigma."""


def suggest_motion(calibrated: CalibratedSite, site: Site) -> str | None:
    """Say which further motion would sharpen the worst drift correction most, or None.

    Each candidate is added to the calibration as two positions either way, seen as the rows
    are, with the target at rest (a Kalman update of all that the calibration knows).
    """
    drifts = [_expect(calibrated, site, motion) for motion in drift_motions(site.quality)]
    now = [drift.sigma_mm(calibrated) for drift in drifts]
    turn = _FURTHER_FACTOR * calibrated.baseline.max_rotation_rad
    best, words = max(now), ""
    for text, axis, amount in _FURTHER:
        step = turn if amount is None else amount
        knowledge = _with_positions(calibrated, site, [_along(axis, step), _along(axis, -step)])
        worst = max(drift.sigma_mm(calibrated, knowledge) for drift in drifts)
        if worst < best:
            best, words = worst, text.format(mrad=turn * 1e3)
    if not words or best > _WORTHWHILE * max(now):
        return None
    return (
        f"to improve most: {words}; the worst of these, {AXES[int(np.argmax(now))]}, would go "
        f"from {max(now):.3f} mm to about {best:.3f} mm"
    )


def _with_positions(calibrated: CalibratedSite, site: Site, motions: Sequence[Pose]) -> FloatArray:
    """(r, r) what is left of the posterior's columns after two views of each further position."""
    information = np.eye(calibrated.posterior.lens.shape[1])
    for motion in motions:
        seen = _expect(calibrated, site, motion)
        weighted = np.linalg.solve(seen.noise_px2 + seen.own_px2, seen.jacobian_px)
        information += 2.0 * seen.jacobian_px.T @ weighted
    return np.asarray(np.linalg.inv(information))


def _along(axis: int, amount: float) -> Pose:
    vector = np.zeros(6)
    vector[axis] = amount
    return Pose.from_vectors(vector[:3], vector[3:])


def determined_share(posterior: Posterior, prior_sigma: FloatArray) -> FloatArray:
    """(8,) how far the views, not the priors, determine each rig parameter: 1 - (post/prior)^2."""
    return np.asarray(np.clip(1.0 - (posterior.model_sigma / prior_sigma) ** 2, 0.0, 1.0))


def describe_model(model: Rig | PaperModel) -> str:
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
