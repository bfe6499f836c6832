"""Whether the main image moves as the drawing of the rig says when the rig turns.

A board or a plate that looks the same mirrored or turned does not show that its image is; the
turns of the rig do: they show in both images, and how the one follows from the other is drawn.
"""

from __future__ import annotations

import numpy as np

from core.arrays import FloatArray
from core.calibration.joint_fit import FitOptions, main_scale, main_view, nominal_rig
from core.calibration.observability import MIN_RIG_VIEWS
from core.calibration.views import Views
from core.checkerboard.resection import resect
from core.errors import CalibrationError
from core.geometry.lens import Lens

_TRIMMED = 0.75
"""Share of the views, those that fit best, that are judged by: in the others the main target may
have moved, or the board may be partly covered. Insensitive."""
_MIN_RATIO = 0.05
"""Of the least shift of the image to the largest, as `observability` has it of the turns: below it
the turns show one direction only."""
_NEAR = 0.3
"""How far the matrix may be from one that exchanges or reverses axes: cameras are turned against
the drawing by a few degrees, 0.1."""
_CHANGES = (
    (((-1.0, 0.0), (0.0, 1.0)), "mirrored (left and right exchanged)"),
    (((1.0, 0.0), (0.0, -1.0)), "flipped (top and bottom exchanged)"),
    (((-1.0, 0.0), (0.0, -1.0)), "turned by 180 degrees"),
    (((0.0, 1.0), (-1.0, 0.0)), "turned by 90 degrees"),
    (((0.0, -1.0), (1.0, 0.0)), "turned by 90 degrees"),
)
"""What the main image's shifts are, in terms of those that the drawing predicts."""


def compare_with_drawing(views: Views, lens: Lens, options: FitOptions) -> float:
    """Compare the main image's shifts with those that the drawn rig predicts for the same turns.

    Gives by how much the main camera's focal length in px, which is scale times distance, is larger
    than drawn: some per cent accurate, 1 where the views do not tell. Raises CalibrationError where
    the shifts fit only with one of the images mirrored or turned.
    """
    seen_px, drawn_px = _shifts_px(views, lens, options)
    if len(seen_px) < MIN_RIG_VIEWS or _flatness(drawn_px) < _MIN_RATIO:
        return 1.0
    follows = _follows(seen_px, drawn_px)
    factor = float(np.sqrt(abs(np.linalg.det(follows))))
    if factor == 0.0:
        return 1.0
    for change, what in _CHANGES:
        if np.abs(follows / factor - np.array(change)).max() < _NEAR:
            angles = ", ".join(f"{deg:g}" for deg in options.site.rig.rotation_main_sub_deg)
            msg = (
                "calibration: when the rig turns, the images move as if one of them were "
                f"{what}; look at both (dcam-ctl preview), switch ReverseX and ReverseY of that "
                f"camera off or turn it, or correct [rig] rotation_main_sub_deg = [{angles}]"
            )
            raise CalibrationError(msg)
    return factor


def _shifts_px(views: Views, lens: Lens, options: FitOptions) -> tuple[FloatArray, FloatArray]:
    """(n, 2) mean shift of the discs in each rig view: as seen, and as drawn for that turn."""
    nominal, reference = options.board.corners_mm, views.reference
    from_rest = resect(lens, nominal, reference.board.view).pose.inverse()
    drawn = nominal_rig(options.site, main_scale(views, options))
    seen, predicted = [], []
    for view in views.rig:
        main = main_view(view.discs, reference.discs)
        if main is not None:
            motion = resect(lens, nominal, view.board.view).pose.compose(from_rest)
            seen.append((main.points_px - main.reference_px).mean(axis=0))
            predicted.append((drawn.move(main.reference_px, motion) - main.reference_px).mean(0))
    return np.array(seen).reshape(-1, 2), np.array(predicted).reshape(-1, 2)


def _flatness(shifts_px: FloatArray) -> float:
    """Least to largest extent of shifts; 0 of those along one line."""
    extent = np.linalg.svd(shifts_px, compute_uv=False)
    return float(extent[1] / extent[0]) if extent[0] > 0.0 else 0.0


def _follows(seen_px: FloatArray, drawn_px: FloatArray) -> FloatArray:
    """(2, 2) seen = this @ drawn: of each two views' matrix, the one that most views fit.

    Then by least squares to the views that fit that one best (least median of squares; Rousseeuw
    1984).
    """
    first, second = np.triu_indices(len(seen_px), 1)
    drawn, seen = (np.stack([v[first], v[second]], axis=2) for v in (drawn_px, seen_px))
    usable = np.linalg.cond(drawn) < 1.0 / _MIN_RATIO
    if usable.any():
        each = seen[usable] @ np.linalg.inv(drawn[usable])
        left = np.linalg.norm(seen_px - (each @ drawn_px.T).transpose(0, 2, 1), axis=2)
        left = left[np.argmin(np.median(left, axis=1))]
        best = left <= np.quantile(left, _TRIMMED)
        seen_px, drawn_px = seen_px[best], drawn_px[best]
    return np.asarray(np.linalg.lstsq(drawn_px, seen_px, rcond=None)[0].T)
