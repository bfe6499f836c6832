"""A calibration says which further motion would sharpen it most, for an engineer to act on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.observability import drift_errors, further_motion
from tests.core.sessions import Session


def test_pan_tilt_alone_asks_for_a_roll(field: Session) -> None:
    """Pan and tilt leave the tilt between the two cameras' axes to the drawing; roll shows it."""
    advice = further_motion(field.calibration.setup, field.site)
    assert advice is not None
    assert "roll the rig about the viewing axis" in advice
    assert "rotation about z" in advice


def test_a_sure_calibration_asks_for_nothing(field: Session) -> None:
    """Where another motion would not help, none is asked for."""
    setup = field.calibration.setup
    columns = setup.posterior.lens.shape[1]
    posterior = setup.posterior.times(1e-4 * np.eye(columns))
    sure = replace(setup, posterior=replace(posterior, own_mm2=1e-8 * posterior.own_mm2))
    assert max(error.calibration_mm for error in drift_errors(sure, field.site)) < 1e-3
    assert further_motion(sure, field.site) is None
