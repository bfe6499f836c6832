"""What a site will measure, before it is built: the same calibration and correction, no images.

Views are projected from the drawing instead of located in images, with the covariance that located
corners and discs would have. The normal equations of the project's own fit, at the truth, give the
covariance of the calibration; its own correction gives that of a row. Nothing is fitted: what is
planned here is the sigma that a calibration and its rows will report.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from core.adjustment.bundle_adjustment import PrintSpread
from core.arrays import FloatArray
from core.calibration.joint_fit import FitOptions, Method, build_uncompressed_site, predict_fit
from core.calibration.observability import AXES, drift_motions
from core.checkerboard.resection import MIN_CORNERS, pose_jacobian
from core.errors import TargetNotFoundError, digits
from core.geometry.pose import Pose
from core.planning.planned_site import CalibrationPlan, PlannedSite
from core.rig.calibrated_site import CalibratedSite
from core.rig.posterior import Posterior, Sensitivities
from core.rig.propagation import (
    DiscCombination,
    mean_of,
    predict_shift_of,
    reference_noise,
    shift_sensitivities,
)
from core.site import Site

FAIR_PRINT = PrintSpread(column_mm=0.005, row_mm=0.005, corner_mm=0.001)
"""How far lines and corners of the board will be from where they should: a good laser print."""


@dataclass(frozen=True, slots=True)
class MotionSigma:
    """What is predicted for one motion of the rig."""

    motion: str
    calibration_mm: float
    """1 sigma of its correction from the calibration alone, the worse direction: as reported."""
    row_mm: float
    """1 sigma of a corrected displacement then, the worse direction: as in a row."""


@dataclass(frozen=True, slots=True)
class PredictedAccuracy:
    """1-sigma errors, mm at the main target."""

    still_mm: FloatArray
    """(2,) x, y of a corrected displacement with the rig where it was at the reference."""
    drifted_mm: FloatArray
    """(2,) x, y with the rig anywhere within the expected drift (each axis evenly spread)."""
    motions: tuple[MotionSigma, ...]
    """The largest expected drift along or about each axis."""

    @property
    def worst_mm(self) -> float:
        """Of the rows predicted."""
        return max(m.row_mm for m in self.motions)

    @property
    def typical_mm(self) -> float:
        """The worse coordinate within the drift."""
        return float(self.drifted_mm.max())


def predict_calibration(planned: PlannedSite, calibration_plan: CalibrationPlan) -> CalibratedSite:
    """Say what a calibration by these views will know; its posterior is whole.

    Raises NotObservableError if the positions do not determine it, TargetNotFoundError if a
    target is out of view.
    """
    require_in_view(planned)
    options = FitOptions(planned.site, planned.board, Method.RIGID, skew=False)
    views = planned.views(calibration_plan)
    fit = predict_fit(views, planned.lens, planned.poses(calibration_plan), options, FAIR_PRINT)
    return build_uncompressed_site(fit, options)


def require_in_view(planned: PlannedSite) -> None:
    """Raise TargetNotFoundError unless a calibration's reference would show both targets."""
    corners = planned.predict_board(planned.T_CS1_WS).visible
    if corners < MIN_CORNERS:
        msg = (
            f"sub target: {corners} corners of the board are in the image, {MIN_CORNERS} are "
            "needed; check [target.sub] and [camera.sub] focal_length_mm"
        )
        raise TargetNotFoundError(msg)
    found = planned.predict_discs(Pose.identity()).found
    if not found.all():
        msg = (
            f"main target: {int(found.sum())} of {len(found)} discs are wholly in the image, all "
            "are needed; check [target.main], or a shorter [camera.main] focal_length_mm"
        )
        raise TargetNotFoundError(msg)


@dataclass(frozen=True, slots=True)
class FrameNoise:
    """How noisy one frame is, as multiples of what its images tell (variance)."""

    corners: float = 1.0
    discs: float = 1.0


@dataclass(frozen=True, slots=True)
class PredictedRow:
    """What the error of a corrected displacement will be made of, at one motion of the rig."""

    sensitivities: Sensitivities
    """Of all that is calibrated, px."""
    pose_px2: FloatArray
    """(2, 2) from the frame's corners."""
    discs_px2: FloatArray
    """(2, 2) from the frame's discs."""
    to_mm: FloatArray
    """(2, 2) mm/px."""

    def calibration_mm2(self, posterior: Posterior) -> FloatArray:
        """Covariance (2, 2) from the calibration alone."""
        return np.asarray(self.to_mm @ self.sensitivities.covariance(posterior) @ self.to_mm.T)

    def covariance_mm2(self, posterior: Posterior, noise: FrameNoise) -> FloatArray:
        """Covariance (2, 2) of a row, as `corrected_displacement` gives it."""
        frame_px2 = noise.corners * self.pose_px2 + noise.discs * self.discs_px2
        return self.calibration_mm2(posterior) + self.to_mm @ frame_px2 @ self.to_mm.T


def predict_row(planned: PlannedSite, calibrated: CalibratedSite, motion: Pose) -> PredictedRow:
    """A row with the rig moved by `T_CSj_CS1`, the main target at rest.

    Raises TargetNotFoundError if the targets are out of view then.
    """
    pair, pose = planned.predict_pair("row", motion), motion.compose(calibrated.reference_pose)
    view, which = pair.board.view, np.nonzero(pair.discs.found)[0]
    if len(view.index) < MIN_CORNERS or len(which) == 0:
        msg = "the expected drift takes a target out of its image: see [quality] expected_drift_*"
        raise TargetNotFoundError(msg)
    weights, root, target = (
        np.full(len(which), 1.0 / len(which)),
        view.whitening(),
        calibrated.main_target,
    )
    prediction = predict_shift_of(calibrated, target, which, motion)
    shift = DiscCombination(target, which, mean_of(weights), prediction)
    sensitivities, by_pose = shift_sensitivities(calibrated, [shift], pose, view, root)
    jacobian = root @ pose_jacobian(calibrated.lens, pose, calibrated.corners_mm[view.index])[1]
    flat = jacobian.reshape(-1, 6)
    return PredictedRow(
        sensitivities,
        by_pose @ np.linalg.solve(flat.T @ flat, by_pose.T),
        pair.discs.covariance_px2[which].mean(axis=0) / len(which),
        np.linalg.inv(calibrated.B),
    )


def drift_rows(planned: PlannedSite, calibrated: CalibratedSite) -> tuple[PredictedRow, ...]:
    """Rows with the rig at rest, then with the largest expected drift about and along each axis."""
    motions = (Pose.identity(), *drift_motions(planned.site.quality))
    return tuple(predict_row(planned, calibrated, motion) for motion in motions)


def predict_accuracy(
    rows: Sequence[PredictedRow], posterior: Posterior, noise: FrameNoise | None = None
) -> PredictedAccuracy:
    """Predict the sigma of corrected displacements at rest and within the drift (`drift_rows`)."""
    noise = noise or FrameNoise()
    still, *drifts = (row.covariance_mm2(posterior, noise) for row in rows)
    # The error of a small motion's correction is linear in the motion; evenly spread within
    # its limits a motion has a third of the variance that its limit has.
    drifted = still + sum((drift - still for drift in drifts), np.zeros((2, 2))) / 3.0
    return PredictedAccuracy(
        np.sqrt(np.diag(still)),
        np.sqrt(np.diag(drifted)),
        tuple(
            MotionSigma(name, _worst_mm(row.calibration_mm2(posterior)), _worst_mm(drift))
            for name, row, drift in zip(AXES, rows[1:], drifts, strict=True)
        ),
    )


def _worst_mm(covariance_mm2: FloatArray) -> float:
    return math.sqrt(np.linalg.eigvalsh(covariance_mm2).max())


@dataclass(frozen=True, slots=True)
class ErrorCause:
    """One cause of error, and what would be left without it."""

    cause: str
    without_mm: float
    """`typical_mm` if this were perfect."""


def error_causes(
    planned: PlannedSite, calibrated: CalibratedSite, rows: Sequence[PredictedRow]
) -> tuple[ErrorCause, ...]:
    """What limits the accuracy: the sigma within the drift if one thing after another were perfect.

    The most costly first. What a part known perfectly leaves is the conditional covariance.
    """
    whole = calibrated.posterior
    parts = {
        "lens of the sub-camera": whole.conditioned_on(whole.lens),
        "print and flatness of the board": whole.conditioned_on_board(),
        "rotation between the cameras": whole.conditioned_on(whole.model[:3]),
        "offset between the cameras": whole.conditioned_on(whole.model[3:6]),
        "distance and scale of the main target": whole.conditioned_on(whole.model[6:8]),
        "noise of the reference's pose": whole.conditioned_on(
            reference_noise(calibrated, planned.site.sub)
        ),
    }
    limits = [
        ErrorCause(cause, predict_accuracy(rows, left).typical_mm) for cause, left in parts.items()
    ]
    quiet = {
        "noise of a frame's pose (sub-camera)": FrameNoise(corners=0.0),
        "noise of the discs (main camera)": FrameNoise(discs=0.0),
    }
    limits += [
        ErrorCause(cause, predict_accuracy(rows, whole, noise).typical_mm)
        for cause, noise in quiet.items()
    ]
    return tuple(sorted(limits, key=lambda limit: limit.without_mm))


@dataclass(frozen=True, slots=True)
class Change:
    """Something that could be done otherwise."""

    what: str
    planned: PlannedSite
    calibration_plan: CalibrationPlan
    noise: FrameNoise = field(default_factory=FrameNoise)


@dataclass(frozen=True, slots=True)
class Improvement:
    """A change, and what it would bring."""

    what: str
    typical_mm: float


_LONGER, _LARGER, _BETTER = 1.5, 1.4, 4.0
"""Factors of the changes tried: sub-camera's focal length, board's size, survey. Steps that can be
bought: 6 to 9 mm, A4 to A3, a total station for a tape."""
WORTHWHILE = 0.9
"""Changes that leave more of the sigma than this are not listed."""


def possible_changes(planned: PlannedSite, calibration_plan: CalibrationPlan) -> tuple[Change, ...]:
    """What an engineer could do otherwise, one thing at a time."""
    site = planned.site
    target, rig, main = site.sub_target, site.rig, site.main_target
    focal_mm = _LONGER * site.sub.focal_length_mm
    longer = replace(site, sub=replace(site.sub, focal_length_mm=focal_mm))
    squares = math.ceil(_LARGER * target.squares_x), math.ceil(_LARGER * target.squares_y)
    larger = replace(target, squares_x=squares[0], squares_y=squares[1])
    surveyed = replace(
        site,
        rig=replace(
            rig,
            rotation_sigma_deg=rig.rotation_sigma_deg / _BETTER,
            offset_sigma_mm=rig.offset_sigma_mm / _BETTER,
        ),
        main_target=replace(main, distance_sigma_mm=main.distance_sigma_mm / _BETTER),
    )
    more = 2 * calibration_plan.lens_views

    def other(changed: Site) -> PlannedSite:
        return replace(planned, site=changed)

    return (
        Change(
            f"{more} lens views instead of {calibration_plan.lens_views}",
            planned,
            replace(calibration_plan, lens_views=more),
        ),
        Change(
            f"a sub-camera lens of {focal_mm:g} mm instead of {site.sub.focal_length_mm:g} mm",
            other(longer),
            calibration_plan,
        ),
        Change(
            f"a larger board, {squares[0]} x {squares[1]} squares of {target.square_mm:g} mm",
            other(replace(site, sub_target=larger)),
            calibration_plan,
        ),
        Change(
            f"a survey four times as good: to {rig.rotation_sigma_deg / 4:.2g} deg between the "
            f"cameras, {digits(rig.offset_sigma_mm / 4, 2)} mm of offset, "
            f"{digits(main.distance_sigma_mm / 4, 2)} mm of distance",
            other(surveyed),
            calibration_plan,
        ),
        Change(
            "four pairs a slot ([schedule] burst = 4)",
            planned,
            calibration_plan,
            FrameNoise(0.25, 0.25),
        ),
    )


def improvements(now: PredictedAccuracy, changes: Sequence[Change]) -> tuple[Improvement, ...]:
    """Plan again with each change; those worth it, the best first."""
    found = []
    for change in changes:
        again = predict_calibration(change.planned, change.calibration_plan)
        rows = drift_rows(change.planned, again)
        typical_mm = predict_accuracy(rows, again.posterior, change.noise).typical_mm
        if typical_mm < WORTHWHILE * now.typical_mm:
            found.append(Improvement(change.what, typical_mm))
    return tuple(sorted(found, key=lambda improvement: improvement.typical_mm))
