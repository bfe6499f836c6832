"""A calibration says which further motion would sharpen it most, for an engineer to act on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.observability import further_motion, motion_sigma_mm
from core.pose import Pose
from tests.core.sessions import Session


def test_pan_tilt_alone_asks_for_a_roll(field: Session) -> None:
    """Pan and tilt leave the tilt between the two cameras' axes to the drawing; roll shows it."""
    advice = further_motion(field.calibration.setup, field.site.quality)
    assert advice is not None
    assert "roll the rig about the viewing axis" in advice
    assert "rotation about z" in advice


def test_a_sure_calibration_asks_for_nothing(field: Session) -> None:
    """Where another motion would not help, none is asked for."""
    setup = field.calibration.setup
    sure = replace(setup, covariance=setup.covariance * 1e-8)
    roll = Pose.from_vectors(np.array([0.0, 0.0, 1e-3]), np.zeros(3))
    assert motion_sigma_mm(sure, roll) < 1e-4
    assert further_motion(sure, field.site.quality) is None
