"""A calibrated site of which only the targets' places in the main image matter."""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.geometry.lens import Lens
from core.geometry.pose import Pose
from core.lens_model import LensModel
from core.rig.calibrated_site import Baseline, CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.posterior import Posterior
from core.rig.rigid import Rig


def seen_there(main_px: FloatArray, B: FloatArray, *further: CalibratedTarget) -> CalibratedSite:
    """Where the targets were in the reference; (n, 2) px and (2, 2) px/mm of the main one."""
    none = np.zeros((0, 0))
    nothing = Posterior(none, none, none, none, none, none)
    camera = np.array([400.0, 400.0, 0.0, 320.0, 200.0, 0.0, 0.0])
    return CalibratedSite(
        Board.of_squares(29, 21, 2.0),
        np.zeros((560, 3)),
        Lens(camera, LensModel.RADIAL),
        Pose.identity(),
        main_px,
        B,
        Rig(Pose.identity(), 11000.0, float(B[0, 0]), np.zeros(2)),
        nothing,
        Baseline(0.01, 1.0, 1.0, 1.0, 1.0, 0.1, 1.0),
        further,
    )
