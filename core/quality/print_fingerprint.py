"""Whether the board in an image is the one that was calibrated, corner for corner.

No print is perfect: each corner is off by some micrometres, and the calibration knows by how much.
That pattern is the board's fingerprint. On the same board, named rightly, what the calibrated
pattern leaves is noise. On another print, or with the corners named a period off, the old pattern
is wrongly taken off and stands in the residuals, with the opposite sign.
"""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.resection import BoardPose, BoardView, pose_jacobian
from core.rig.calibrated_site import CalibratedSite


def print_errors_mm(calibrated: CalibratedSite) -> FloatArray:
    """(corners, 2) each corner's own offset: what the board's scale, shear and bow leave."""
    departure = calibrated.corners_mm - calibrated.board.corners_mm
    terms = calibrated.shape_terms.reshape(departure.size, -1)
    shape = np.linalg.lstsq(terms, departure.ravel(), rcond=None)[0]
    return np.asarray((departure.ravel() - terms @ shape).reshape(-1, 3)[:, :2])


def print_mismatch(
    calibrated: CalibratedSite, view: BoardView, board: BoardPose
) -> tuple[float, float]:
    """How much of the calibrated print errors is missing in an image, and their size in px.

    With p the print errors in the image and r the residuals, both less what a pose could make of
    them: the share is -(p r) / (p p), 0 on the calibrated board and 1 on one that has nothing in
    common with it; the size is the rms of p, one coordinate. (0, 0) for a board taken as perfect.
    """
    _, by_pose, by_point, _ = pose_jacobian(
        calibrated.lens, board.pose, calibrated.corners_mm[view.index]
    )
    root = np.sqrt(board.weights)[:, None]
    moved = by_point[:, :, :2] @ print_errors_mm(calibrated)[view.index][:, :, None]
    pattern = (moved[:, :, 0] * root).ravel()
    rest = (board.residuals_px * root).ravel()
    flat = (by_pose * root[:, :, None]).reshape(-1, 6)
    pattern = pattern - flat @ np.linalg.lstsq(flat, pattern, rcond=None)[0]
    squares = float(pattern @ pattern)
    if squares == 0.0:
        return 0.0, 0.0
    return -float(pattern @ rest) / squares, float(np.sqrt(squares / pattern.size))
