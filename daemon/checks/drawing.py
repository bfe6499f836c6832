"""The site as it is drawn in the config: scale, room for the drift, directions of the cameras."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from core.planning.field_of_view import further_views, further_warnings
from core.rig.compensation import affine_error_px
from core.site import RigPrior, Site
from daemon.checks.finding import Finding

SAME_WAY_DEG = 60.0
"""Cameras with less between their directions look the same way."""


LONGEST_OFFSET_MM = 1000.0
"""Two cameras that are further apart are hardly one rigid rig."""


def check_drawing(site: Site) -> Iterator[Finding]:
    """What the drawing promises: scale, room for the drift in the main image, Eq. 5."""
    main, target, drift = site.main, site.main_target, site.quality
    px_per_mm = main.focal_px / target.distance_mm
    half_view_mm = np.array([main.width_px, main.height_px]) / 2.0 / px_per_mm
    half_target_mm = np.abs(target.centres_mm).max(axis=0) + target.diameters_mm.max() / 2.0
    free_mm = float((half_view_mm - half_target_mm).min())
    drift_mm = drift.expected_drift_mrad * 1e-3 * target.distance_mm + drift.expected_drift_mm
    text = (
        f"{px_per_mm:.3g} px/mm at {target.distance_mm:g} mm; the target may move {free_mm:.0f} mm "
        f"before it leaves the image, the expected drift alone is {drift_mm:.0f} mm"
    )
    if free_mm < drift_mm:
        yield Finding("main image", "warning", f"{text}: a shorter lens gives more room")
    else:
        yield Finding("main image", "ok", text)
    off_axis_px = float(np.abs(target.centres_mm).max()) * px_per_mm
    eq5_px = affine_error_px(target.distance_mm, drift.expected_drift_mm, off_axis_px)
    state: Literal["ok", "warning"] = "ok" if eq5_px < 1.0 else "warning"
    yield Finding("Eq. 5", state, f"{eq5_px:.3f} px, must be below 1 px for --method paper")
    yield from _further_targets(site)
    yield from _rig(site)
    square_px = site.sub_target.square_mm * site.sub.focal_px / site.sub_target.distance_mm
    seen = min(site.sub.width_px, site.sub.height_px) / square_px
    text = f"{square_px:.1f} px a square, {seen:.0f} squares across the shorter side"
    yield Finding("sub image", "ok", text)


def _further_targets(site: Site) -> Iterator[Finding]:
    for view in further_views(site):
        room = ""
        if view.travel_mm is not None:
            room = f", it may move {view.travel_mm.min():.0f} mm before it leaves the image"
        text = f"{view.px_per_mm:.3g} px/mm at {view.distance_mm:g} mm, {view.role}{room}"
        yield Finding(f"target {view.name}", "ok", text)
    for warning in further_warnings(site):
        yield Finding("further targets", "warning", warning)


def _rig(site: Site) -> Iterator[Finding]:
    """How the cameras stand to one another as drawn; what is unusual is a warning, no error."""
    unusual = [text for text in (_directions(site.rig), _offset(site), _hidden(site)) if text]
    for text in unusual:
        yield Finding("rig", "warning", text)
    if not unusual:
        text = f"drawn with {_between_deg(site.rig):.0f} degrees between the cameras' directions"
        yield Finding("rig", "ok", text)


def _between_deg(rig: RigPrior) -> float:
    """Angle between the cameras' directions."""
    turned = Rotation.from_euler("xyz", rig.rotation_main_sub_deg, degrees=True)
    return float(np.degrees(np.arccos(np.clip(turned.as_matrix()[2, 2], -1.0, 1.0))))


def _directions(rig: RigPrior) -> str | None:
    """Two targets in one direction would not tell drift from motion."""
    angle_deg = _between_deg(rig)
    if angle_deg >= SAME_WAY_DEG:
        return None
    return (
        f"drawn with {angle_deg:.0f} degrees between the cameras' directions, looking the same "
        "way: the sub-camera would look at the bridge, not at the pier; back to back is "
        "rig.rotation_main_sub_deg = [0.0, 180.0, 0.0]. Leave it if the rig is built so"
    )


def _offset(site: Site) -> str | None:
    apart_mm = float(np.linalg.norm(site.rig.offset_main_sub_mm))
    if apart_mm <= LONGEST_OFFSET_MM:
        return None
    return (
        f"drawn with {apart_mm / 1e3:.3g} m between the cameras, which must be rigidly bolted "
        "together: rig.offset_main_sub_mm is in mm, and from optical centre to optical centre. "
        "Leave it if the rig is so large"
    )


def _hidden(site: Site) -> str | None:
    """Whether the main camera as drawn would look at the board, or stand in front of it."""
    T_CM_CS = Rotation.from_euler("xyz", site.rig.rotation_main_sub_deg, degrees=True)
    board_CS = np.array([0.0, 0.0, site.sub_target.distance_mm])
    x, y, z = T_CM_CS.apply(board_CS) + site.rig.offset_main_sub_mm
    half_mm = (
        0.5 * site.sub_target.square_mm * max(site.sub_target.squares_x, site.sub_target.squares_y)
    )
    if 0.0 < z < site.main_target.distance_mm and np.hypot(x, y) < half_mm:
        return (
            "as drawn the board is in front of the main camera and hides the main target: turn "
            "rig.rotation_main_sub_deg (back to back is [0.0, 180.0, 0.0]) or correct the sign of "
            "rig.offset_main_sub_mm"
        )
    return None
