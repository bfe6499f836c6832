"""The numerics: images and numbers in, numbers with covariance out.

This is the front door: what other programs need stands here, loaded when first asked for, so that
who needs a type alone does not wait for the numerics.

    from core import find_target, calibrate_lens, board_pose, calibrate, measure_pair
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from core.calibration.calibrate import (
        Calibration,
        CalibrationView,
        Method,
        ViewRole,
        calibrate,
    )
    from core.checkerboard.board import Board
    from core.checkerboard.board_pose import board_pose
    from core.discs.target import find_target
    from core.errors import CalibrationError, CoreError, ImageError, TargetNotFoundError
    from core.geometry.lens import Lens
    from core.geometry.pose import Pose
    from core.images import GreyImage
    from core.lens.intrinsics import calibrate_lens, calibrate_lens_from_corners
    from core.lens_model import LensModel
    from core.measurement import measure_pair
    from core.results import CalibrationReport, Displacement, Flag, Measurement, Reason
    from core.site import CameraGeometry, CheckerboardTarget, CirclesTarget, RigPrior, Site

__all__ = [
    "Board",
    "Calibration",
    "CalibrationError",
    "CalibrationReport",
    "CalibrationView",
    "CameraGeometry",
    "CheckerboardTarget",
    "CirclesTarget",
    "CoreError",
    "Displacement",
    "Flag",
    "GreyImage",
    "ImageError",
    "Lens",
    "LensModel",
    "Measurement",
    "Method",
    "Pose",
    "Reason",
    "RigPrior",
    "Site",
    "TargetNotFoundError",
    "ViewRole",
    "board_pose",
    "calibrate",
    "calibrate_lens",
    "calibrate_lens_from_corners",
    "find_target",
    "measure_pair",
]

_MODULES = {
    "core.calibration.calibrate": (
        *("Calibration", "CalibrationView", "Method", "ViewRole", "calibrate"),
    ),
    "core.checkerboard.board": ("Board",),
    "core.checkerboard.board_pose": ("board_pose",),
    "core.discs.target": ("find_target",),
    "core.errors": ("CalibrationError", "CoreError", "ImageError", "TargetNotFoundError"),
    "core.geometry.lens": ("Lens",),
    "core.geometry.pose": ("Pose",),
    "core.images": ("GreyImage",),
    "core.lens.intrinsics": ("calibrate_lens", "calibrate_lens_from_corners"),
    "core.lens_model": ("LensModel",),
    "core.measurement": ("measure_pair",),
    "core.results": ("CalibrationReport", "Displacement", "Flag", "Measurement", "Reason"),
    "core.site": (*("CameraGeometry", "CheckerboardTarget", "CirclesTarget", "RigPrior", "Site"),),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load the module in which a name is at home (PEP 562)."""
    if name not in _HOME:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    return getattr(importlib.import_module(_HOME[name]), name)
