"""The site as it is drawn in the config: scale, room for the drift, directions of the cameras."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from core.rig.compensation import affine_error_px
from core.site import RigPrior, Site
from daemon.checks.finding import Finding

SAME_WAY_DEG = 60.0
"""Cameras with less between their directions look the same way."""


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
    yield _directions(site.rig)
    square_px = site.sub_target.square_mm * site.sub.focal_px / site.sub_target.distance_mm
    seen = min(site.sub.width_px, site.sub.height_px) / square_px
    text = f"{square_px:.1f} px a square, {seen:.0f} squares across the shorter side"
    yield Finding("sub image", "ok", text)


def _directions(rig: RigPrior) -> Finding:
    """How the cameras look: two targets in one direction would not tell drift from motion."""
    turned = Rotation.from_euler("xyz", rig.rotation_main_sub_deg, degrees=True)
    angle_deg = float(np.degrees(np.arccos(np.clip(turned.as_matrix()[2, 2], -1.0, 1.0))))
    text = f"drawn with {angle_deg:.0f} degrees between the cameras' directions"
    if angle_deg < SAME_WAY_DEG:
        text += ", looking the same way: is rig.rotation_main_sub_deg right? back to back is 180"
        return Finding("rig", "warning", text)
    return Finding("rig", "ok", text)
