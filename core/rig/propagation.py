"""How a row's false shift changes with everything calibrated: its exact first derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import FloatArray, IntArray
from core.checkerboard.resection import BoardView, pose_jacobian, visible_corners
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.rig.calibrated_site import CalibratedSite
from core.rig.paper import PaperModel
from core.rig.posterior import Sensitivities
from core.rig.rigid import Rig, motion_by_pose, motion_by_reference
from core.site import CameraGeometry

DISC_FLOOR_PX = 0.0007
"""1 sigma that a located disc has at least, however low the noise. Insensitive."""
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


def shift_sensitivities(
    calibrated: CalibratedSite,
    prediction: ShiftPrediction,
    which: IntArray,
    weights: FloatArray,
    pose: Pose,
    view: BoardView,
    root: FloatArray,
) -> tuple[Sensitivities, FloatArray]:
    """How the discs' mean false place, (2,) px, follows the calibration, and the pose (2, 6).

    weights (n,) of the discs `which` sum to 1; root (corners seen, 2, 2) is what the pose was
    fitted with.
    """
    motion = pose.compose(calibrated.reference_pose.inverse())
    by_motion = np.einsum("k,kab->ab", weights, prediction.by_motion)
    by_model = np.einsum("k,kab->ab", weights, prediction.by_model)
    by_pose = by_motion @ motion_by_pose(motion, calibrated.reference_pose)
    by_reference = by_motion @ motion_by_reference(motion, calibrated.reference_pose)
    by_lens, by_corners = sensitivity_through_pose(
        calibrated.lens, pose, calibrated.corners_mm, view, root, by_pose
    )
    by_discs = np.zeros((2, len(calibrated.reference_discs_px), 2))
    by_discs[:, which] = np.eye(2)[:, None] * weights[:, None]
    floor = np.diag((MAIN_GEOMETRY_SHARE * (weights @ prediction.shift_px)) ** 2)
    return (
        Sensitivities(by_lens, by_model, by_reference, by_discs, view.index, by_corners, floor),
        by_pose,
    )


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

    The discs all count alike.
    """
    pose = motion.compose(calibrated.reference_pose)
    view = expected_view(calibrated, camera, pose)
    which = np.nonzero(np.isfinite(calibrated.reference_discs_px).all(axis=1))[0]
    prediction = predict_shift(calibrated.model, calibrated.reference_discs_px[which], motion)
    weights = np.full(len(which), 1.0 / len(which))
    root = view.whitening()
    sensitivities, by_pose = shift_sensitivities(
        calibrated, prediction, which, weights, pose, view, root
    )
    jacobian = root @ pose_jacobian(calibrated.lens, pose, calibrated.corners_mm[view.index])[1]
    flat = jacobian.reshape(-1, 6)
    noise = by_pose @ np.linalg.solve(flat.T @ flat, by_pose.T)
    return sensitivities, noise + 2.0 * DISC_FLOOR_PX**2 / len(which) * np.eye(2)
