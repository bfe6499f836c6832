"""A camera that has rolled sees a displacement rolled: it is turned back."""

from __future__ import annotations

import numpy as np

from core.geometry.pose import Pose
from core.rig.propagation import predict_shift_of, turned_B
from core.rig.rigid import Rig
from tests.core.sessions import Session


def test_twenty_millimetres_up_stay_up_when_the_camera_has_rolled(usual: Session) -> None:
    """5 mrad of roll would put 0.1 mm of 20 mm into x."""
    calibrated = usual.calibration.calibrated
    assert isinstance(calibrated.model, Rig)
    target, motion = calibrated.main_target, Pose.from_vectors(np.array([0, 0, 5e-3]), np.zeros(3))
    moved_mm = np.array([0.0, 20.0])
    at_rest = predict_shift_of(calibrated, target, np.arange(5), motion).shift_px
    displaced_px = target.reference_px + target.B @ moved_mm
    shift_px = calibrated.model.move(displaced_px, motion) - target.reference_px - at_rest
    mean_px = shift_px.mean(axis=0)
    turned_mm = np.linalg.solve(turned_B(calibrated, target, motion), mean_px)
    np.testing.assert_allclose(turned_mm, moved_mm, atol=0.002)
    assert abs(np.linalg.solve(target.B, mean_px)[0]) > 0.09
