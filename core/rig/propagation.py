"""How a row's false shift changes with everything calibrated: its exact first derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from core.arrays import FloatArray, IntArray
from core.checkerboard.resection import BoardView, pose_jacobian, visible_corners
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.paper import PaperModel
from core.rig.posterior import Sensitivities
from core.rig.rigid import Rig, motion_by_pose, motion_by_reference
from core.site import CameraGeometry

_PROBE_PX = 100.0
"""Over which the derivative of the image by a target's place is taken; the map is nearly linear."""
MAIN_GEOMETRY_SHARE = 5e-5
"""Of a false shift: the main camera is modelled without distortion and with square pixels. Sites
with pixels off square by 1 in 10,000, as simulated, have this error."""


@dataclass(frozen=True, slots=True)
class ShiftPrediction:
    """False shift of each disc, with its derivatives."""

    shift_px: FloatArray
    """(n, 2)."""
    by_motion: FloatArray
    """(n, 2, 6)."""
    by_model: FloatArray
    """(n, 2, m) by the parameters of the rig (8) or of the paper's model (9)."""
    by_distance: FloatArray | None = None
    """(n, 2) by the natural logarithm of a further target's own distance."""


def predict_shift_of(
    calibrated: CalibratedSite, target: CalibratedTarget, which: IntArray, motion: Pose
) -> ShiftPrediction:
    """Predict how the rig's motion shifts some discs (n,) of a target at rest.

    A further target is at its own distance, seen by the same main camera: its parallax differs.
    """
    model, points_px = calibrated.model, target.reference_px[which]
    if target.role is None or not isinstance(model, Rig):
        return predict_shift(model, points_px, motion)
    there = _rig_of(model, target)
    moved, by_motion, by_rig = there.move_jacobians(points_px, motion)
    by_model = by_rig.copy()
    # The focal length is the main target's depth times its scale.
    by_model[:, :, 6] = by_model[:, :, 7] = by_rig[:, :, 7]
    return ShiftPrediction(
        moved - points_px, by_motion, by_model, by_rig[:, :, 6] - by_rig[:, :, 7]
    )


def turned_B(calibrated: CalibratedSite, target: CalibratedTarget, motion: Pose) -> FloatArray:
    """B~ (2, 2) px/mm after the rig's motion: a camera that has rolled sees a displacement rolled.

    Eq. 20 keeps the reference's, which at 1 mrad of roll puts 0.02 mm of 20 mm up into x. (The
    paper's model has no roll.)
    """
    if not isinstance(calibrated.model, Rig):
        return target.B
    here = target.middle_px + _PROBE_PX * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    moved = _rig_of(calibrated.model, target).move(here, motion)
    return np.asarray((moved[1:] - moved[0]).T / _PROBE_PX @ target.B)


def _rig_of(model: Rig, target: CalibratedTarget) -> Rig:
    """The rig with a further target's distance in place of the main one's."""
    if target.role is None:
        return model
    return Rig(
        model.T_CM_CS, target.distance_mm, model.focal_px / target.distance_mm, model.centre_px
    )


def predict_shift(
    model: Rig | PaperModel, reference_px: FloatArray, motion: Pose
) -> ShiftPrediction:
    """Predict how the rig's motion shifts the image of a target at rest (Eq. 17)."""
    if isinstance(model, Rig):
        moved, by_motion, by_rig = model.move_jacobians(reference_px, motion)
        return ShiftPrediction(moved - reference_px, by_motion, by_rig)
    n = len(reference_px)
    by_motion, by_parameters = model.shift_jacobians(motion)
    return ShiftPrediction(
        np.tile(model.shift(motion), (n, 1)),
        np.tile(by_motion, (n, 1, 1)),
        np.tile(by_parameters, (n, 1, 1)),
    )


def sensitivity_through_pose(
    lens: Lens,
    pose: Pose,
    corners_mm: FloatArray,
    view: BoardView,
    root: FloatArray,
    by_pose: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """How a value that rests on a fitted pose follows lens and board.

    The pose is where J^T W (u - f) = 0, so it moves by -(J^T W J)^-1 J^T W df/dx. by_pose (k, 6)
    is the value's derivative; gives those by lens (k, lens parameters) and by the corners seen
    (k, n, 3). root (n, 2, 2) whitens; corners_mm (corners, 3) is the whole board.
    """
    _, jacobian, by_point, by_lens = pose_jacobian(lens, pose, corners_mm[view.index])
    n, k = len(view.index), len(by_pose)
    weighted = root.transpose(0, 2, 1) @ (root @ jacobian)
    normal = jacobian.reshape(-1, 6).T @ weighted.reshape(-1, 6)
    gain = weighted @ -np.linalg.solve(normal, by_pose.T)
    through_lens = gain.reshape(-1, k).T @ by_lens.reshape(2 * n, -1)
    through_corners = gain.transpose(0, 2, 1) @ by_point
    return through_lens, through_corners.transpose(1, 0, 2)


@dataclass(frozen=True, slots=True)
class DiscCombination:
    """Sums over a target's discs, such as their mean shift, with the rig's motion predicted."""

    target: CalibratedTarget
    which: IntArray
    """(n,) the discs used."""
    sums: FloatArray
    """(m, n, 2): each of m values is the sum of this times the discs' shifts (n, 2)."""
    prediction: ShiftPrediction
    """Of these discs."""

    def of(self, by_disc: FloatArray) -> FloatArray:
        """(m, ...) of something known by disc, (n, 2, ...)."""
        return np.asarray(np.einsum("mka,ka...->m...", self.sums, by_disc))


def mean_of(weights: FloatArray) -> FloatArray:
    """(2, n, 2) of a mean with weights (n,), which sum to 1."""
    return np.eye(2)[:, None, :] * weights[None, :, None]


def turn_and_scale_of(weights: FloatArray, points_px: FloatArray) -> FloatArray:
    """(2, n, 2) of the turn (rad) and relative change of scale about the discs' mean."""
    away = points_px - weights @ points_px
    about = np.stack([np.stack([-away[:, 1], away[:, 0]], axis=1), away])
    return np.asarray(weights[None, :, None] * about / (weights @ (away**2).sum(axis=1)))


def shift_sensitivities(
    calibrated: CalibratedSite,
    combinations: Sequence[DiscCombination],
    pose: Pose,
    view: BoardView,
    root: FloatArray,
) -> tuple[Sensitivities, FloatArray]:
    """How sums over discs (m in all) follow the calibration, and the pose (m, 6).

    root (corners seen, 2, 2) is what the pose was fitted with.
    """
    motion = pose.compose(calibrated.reference_pose.inverse())
    by_motion = np.concatenate([c.of(c.prediction.by_motion) for c in combinations])
    by_model = np.concatenate([c.of(c.prediction.by_model) for c in combinations])
    by_pose = by_motion @ motion_by_pose(motion, calibrated.reference_pose)
    by_reference = by_motion @ motion_by_reference(motion, calibrated.reference_pose)
    by_lens, by_corners = sensitivity_through_pose(
        calibrated.lens, pose, calibrated.corners_mm, view, root, by_pose
    )
    by_discs = np.concatenate([_by_main_discs(calibrated, c) for c in combinations])
    floor = _geometry_floor(combinations) + block_diagonal([_floor(c) for c in combinations])
    return (
        Sensitivities(by_lens, by_model, by_reference, by_discs, view.index, by_corners, floor),
        by_pose,
    )


def _by_main_discs(calibrated: CalibratedSite, combination: DiscCombination) -> FloatArray:
    """(m, discs, 2) by the places of the main target's discs in the reference."""
    by_discs = np.zeros((len(combination.sums), len(calibrated.reference_discs_px), 2))
    if combination.target.role is None:
        by_discs[:, combination.which] = combination.sums
    return by_discs


def geometry_errors(combinations: Sequence[DiscCombination]) -> FloatArray:
    """(m, 2) px: 1 sigma of what the plain model of the main camera leaves out, along u and v.

    Pixels off square, or a focal length that differs along u and v, scale the false shift of every
    target in the image by the same share.
    """
    errors = []
    for c in combinations:
        along = [c.of(c.prediction.shift_px * axis) for axis in np.eye(2)]
        errors.append(MAIN_GEOMETRY_SHARE * np.stack(along, axis=1))
    return np.concatenate(errors)


def _geometry_floor(combinations: Sequence[DiscCombination]) -> FloatArray:
    errors = geometry_errors(combinations)
    return np.asarray(errors @ errors.T)


def _floor(combination: DiscCombination) -> FloatArray:
    """(m, m) of the reference and the distance of a further target."""
    target, sums = combination.target, combination.sums
    floor = np.einsum("mka,lka,k->ml", sums, sums, target.reference_px2[combination.which])
    if combination.prediction.by_distance is not None:
        share = target.distance_sigma_mm / target.distance_mm
        by_distance = share * combination.of(combination.prediction.by_distance)
        floor += np.outer(by_distance, by_distance)
    return np.asarray(floor)


def block_diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """A matrix of square blocks."""
    return np.asarray(scipy.linalg.block_diag(*blocks), dtype=float)


def reference_noise(calibrated: CalibratedSite, camera: CameraGeometry) -> FloatArray:
    """(6, r) rows of the reference pose's own error, by the posterior's columns.

    That is what is left of it once the errors of lens and board have had their effect.
    """
    view = expected_view(calibrated, camera, calibrated.reference_pose)
    by_lens, by_corners = sensitivity_through_pose(
        calibrated.lens,
        calibrated.reference_pose,
        calibrated.corners_mm,
        view,
        view.whitening(),
        np.eye(6),
    )
    nothing = np.zeros((6, len(calibrated.posterior.model)))
    no_discs = np.zeros((6, len(calibrated.reference_discs_px), 2))
    sensitivities = Sensitivities(
        by_lens, nothing, np.zeros((6, 6)), no_discs, view.index, by_corners, np.zeros((6, 6))
    )
    return calibrated.posterior.reference - sensitivities.propagate(calibrated.posterior)


def expected_view(calibrated: CalibratedSite, camera: CameraGeometry, pose: Pose) -> BoardView:
    """The corners that a pose `T_CS_WS` puts into the image, as noisy as at calibration."""
    size_px = camera.width_px, camera.height_px
    index, points = visible_corners(calibrated.lens, pose, calibrated.corners_mm, size_px)
    noise = np.tile(calibrated.baseline.sub_rms_px**2 * np.eye(2), (len(index), 1, 1))
    return BoardView(index, points, noise)


def expected_sensitivities(
    calibrated: CalibratedSite, camera: CameraGeometry, motion: Pose
) -> tuple[Sensitivities, FloatArray]:
    """What a row would have after this rig motion: effects, and the image noise (2, 2) px^2.

    Of the main target; the discs all count alike, and are as noisy as in the reference.
    """
    target = calibrated.main_target
    sensitivities, by_pose, noise = _expected(calibrated, [target], camera, motion)
    seen = calibrated.posterior.discs[np.isfinite(target.reference_px).all(axis=1)]
    discs_px2 = np.einsum("kar,kbr->ab", seen, seen) / len(seen) ** 2
    return sensitivities, by_pose @ noise @ by_pose.T + discs_px2


def expected_effects(
    calibrated: CalibratedSite, camera: CameraGeometry, motion: Pose
) -> FloatArray:
    """(2 targets, r) rows of the posterior's factor that a row sees of all targets."""
    targets = [calibrated.main_target, *calibrated.further]
    return _expected(calibrated, targets, camera, motion)[0].propagate(calibrated.posterior)


def _expected(
    calibrated: CalibratedSite,
    targets: Sequence[CalibratedTarget],
    camera: CameraGeometry,
    motion: Pose,
) -> tuple[Sensitivities, FloatArray, FloatArray]:
    """Effects, d(mean shift)/d(pose) and the pose's covariance (6, 6) by image noise."""
    pose = motion.compose(calibrated.reference_pose)
    view = expected_view(calibrated, camera, pose)
    shifts = []
    for target in targets:
        which = np.nonzero(np.isfinite(target.reference_px).all(axis=1))[0]
        prediction = predict_shift_of(calibrated, target, which, motion)
        mean = mean_of(np.full(len(which), 1.0 / len(which)))
        shifts.append(DiscCombination(target, which, mean, prediction))
    root = view.whitening()
    sensitivities, by_pose = shift_sensitivities(calibrated, shifts, pose, view, root)
    jacobian = root @ pose_jacobian(calibrated.lens, pose, calibrated.corners_mm[view.index])[1]
    flat = jacobian.reshape(-1, 6)
    return sensitivities, by_pose, np.linalg.inv(flat.T @ flat)
