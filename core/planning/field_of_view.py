"""What the cameras see of a site as drawn, and how far target and rig may move in their view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import bisect

from core.arrays import BoolArray, FloatArray
from core.geometry.pose import Pose
from core.planning.planned_site import OUTLINE, CalibrationPlan, PlannedSite
from core.rig.compensation import AFFINE_LIMIT_PX, affine_error_px
from core.site import CirclesTarget, ExtraTarget, Site, TargetRole

FEW_PX_SQUARE = 12.0
"""Smaller squares have edges that overlap in a blurred image."""
FEW_PX_DISC = 12.0
"""Likewise the diameter of a disc."""
ALIKE_SIZE = 1.5
"""Targets whose sizes in the image differ by more are told apart by that."""
ALIKE_SHARE = 0.1
"""Share of a layout's size within which discs stand alike in two layouts."""
_SHIFT_STEP_MM = 0.01
"""To this the travel of the rig is searched; it is printed to 0.1 mm."""


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """Scales, fields of view and travel."""

    main_px_per_mm: float
    sub_px_per_mm: float
    main_field_mm: FloatArray
    """(2,) width and height of the main image at its target."""
    sub_field_mm: FloatArray
    """(2,) likewise of the sub image at the board."""
    disc_px: float
    """Diameter of the smallest disc."""
    square_px: float
    corners_seen: int
    corners: int
    target_travel_mm: FloatArray
    """(2,) how far the main target may move in x and y, either way, the rig at rest."""
    rig_turn_mrad: FloatArray
    """(2,) how far the rig may pan and tilt before the main target leaves its image."""
    rig_shift_mm: FloatArray
    """(2,) how far the rig may shift in x and y with half of the corners still in view."""
    drift_mm: float
    """What the expected drift alone moves the main target in its image, worst direction."""
    affine_error_px: float
    """Eq. 5 for the expected drift; below 1 px for the paper's method."""


def field_of_view(planned: PlannedSite) -> FieldOfView:
    """Work out what is seen and how far things may move."""
    site, limits = planned.site, planned.site.quality
    scale, target = site.nominal_px_per_mm, site.main_target
    sub_scale = site.sub.focal_px / site.sub_target.distance_mm
    size = np.array([site.main.width_px, site.main.height_px], dtype=float)
    radius_mm = OUTLINE * 0.5 * float(target.diameters_mm.max())
    reach_mm = np.abs(target.centres_mm).max(axis=0) + radius_mm
    travel = np.maximum(0.5 * size / scale - reach_mm, 0.0)
    off_axis = float(np.abs(target.centres_mm).max()) * scale
    return FieldOfView(
        scale,
        sub_scale,
        size / scale,
        np.array([site.sub.width_px, site.sub.height_px]) / sub_scale,
        float(target.diameters_mm.min()) * scale,
        site.sub_target.square_mm * sub_scale,
        planned.predict_board(planned.T_CS1_WS).visible,
        len(planned.board.corners_mm),
        travel,
        travel / target.distance_mm * 1e3,
        np.array([_shift_to_half(planned, axis) for axis in range(2)]),
        limits.expected_drift_mrad * 1e-3 * target.distance_mm + limits.expected_drift_mm,
        affine_error_px(target.distance_mm, limits.expected_drift_mm, off_axis),
    )


@dataclass(frozen=True, slots=True)
class FurtherView:
    """How the main camera sees a further target."""

    name: str
    role: TargetRole
    distance_mm: float
    px_per_mm: float
    field_mm: FloatArray
    """(2,) width and height of the main image at its distance."""
    disc_px: float
    """Diameter of the smallest disc."""
    drift_mm: float
    """What the expected drift alone moves it in the image, worst direction."""
    travel_mm: FloatArray | None
    """(2,) how far it may move in x and in y before it leaves the image; None where the config does
    not say where it is."""


def further_views(site: Site) -> tuple[FurtherView, ...]:
    """Work out what is seen of each further target."""
    return tuple(_further_view(site, extra) for extra in site.extra_targets)


def _further_view(site: Site, extra: ExtraTarget) -> FurtherView:
    target, limits = extra.target, site.quality
    scale = site.main.focal_px / target.distance_mm
    size_px = np.array([site.main.width_px, site.main.height_px], dtype=float)
    travel = None
    if extra.position_px is not None:
        middle = (target.centres_mm.min(axis=0) + target.centres_mm.max(axis=0)) / 2.0
        radius_mm = OUTLINE * 0.5 * float(target.diameters_mm.max())
        reach_mm = np.abs(target.centres_mm - middle).max(axis=0) + radius_mm
        edge_px = np.minimum(extra.position_px + 0.5, size_px - 0.5 - extra.position_px)
        travel = np.maximum(edge_px / scale - reach_mm, 0.0)
    return FurtherView(
        extra.name,
        extra.role,
        target.distance_mm,
        scale,
        size_px / scale,
        float(target.diameters_mm.min()) * scale,
        limits.expected_drift_mrad * 1e-3 * target.distance_mm + limits.expected_drift_mm,
        travel,
    )


def further_warnings(site: Site) -> Iterator[str]:
    """Say which further targets will not be seen well, with what to do."""
    for view in further_views(site):
        if view.disc_px < FEW_PX_DISC:
            yield (
                f"target {view.name}: a disc is only {view.disc_px:.1f} px across, "
                f"{FEW_PX_DISC:.0f} px are needed: larger discs"
            )
        if view.travel_mm is not None and view.travel_mm.min() <= view.drift_mm:
            yield (
                f"target {view.name}: the expected drift moves it by {view.drift_mm:.0f} mm in the "
                f"image, {view.travel_mm.min():.0f} mm are free: hang it nearer to the middle of "
                "the image"
            )
    yield from _alike_warnings(site)


def _alike_warnings(site: Site) -> Iterator[str]:
    """Targets of one layout and about one size in the image need their places."""
    known: list[tuple[str, FloatArray]] = [("the main target", _outline_px(site, site.main_target))]
    for extra in site.extra_targets:
        outline_px = _outline_px(site, extra.target)
        alike = [name for name, other in known if _look_alike(outline_px, other)]
        if alike and extra.position_px is None:
            yield (
                f"target {extra.name} looks like {alike[0]} in the image: write its position_px, "
                "about where its middle is in the image, or give it another layout"
            )
        known.append((f"target {extra.name}", outline_px))


def _outline_px(site: Site, target: CirclesTarget) -> FloatArray:
    """(n, 2) the discs about their middle, in px, as seen from the front."""
    places = target.centres_mm * (site.main.focal_px / target.distance_mm)
    return np.asarray(places - places.mean(axis=0))


def _look_alike(one: FloatArray, other: FloatArray) -> bool:
    """Whether two layouts are the same but for some of their size."""
    if len(one) != len(other):
        return False
    size, other_size = (np.ptp(places, axis=0).max() for places in (one, other))
    if max(size, other_size) > ALIKE_SIZE * min(size, other_size):
        return False
    away = np.hypot(*np.moveaxis(one[:, None] / size - other[None] / other_size, -1, 0))
    return bool((away.min(axis=1) < ALIKE_SHARE).all())


def _shift_to_half(planned: PlannedSite, axis: int) -> float:
    """How far the rig may shift along an axis until half of the corners have left the image."""
    at_rest = planned.predict_board(planned.T_CS1_WS).visible
    target = planned.site.sub_target

    def enough(shift_mm: float) -> float:
        moved = Pose(np.eye(3), shift_mm * np.eye(3)[axis]).compose(planned.T_CS1_WS)
        return 1.0 if 2 * planned.predict_board(moved).visible >= at_rest else -1.0

    if at_rest == 0:
        return 0.0
    out_of_view_mm = 2.0 * target.square_mm * max(target.squares_x, target.squares_y)
    return float(bisect(enough, 0.0, out_of_view_mm, xtol=_SHIFT_STEP_MM))


def planning_warnings(
    planned: PlannedSite, calibration_plan: CalibrationPlan, view: FieldOfView
) -> Iterator[str]:
    """Say what will not work as drawn, with what to do."""
    limits = planned.site.quality
    spare_mm = view.target_travel_mm - view.drift_mm
    if spare_mm.min() <= 0.0:
        yield (
            f"the expected drift moves the main target by {view.drift_mm:.0f} mm in its image, "
            f"{view.target_travel_mm.min():.0f} mm are free: a shorter main lens or a larger sensor"
        )
    lost = [p for p in calibration_plan.positions_deg if not _whole(planned, p).all()]
    if lost:
        yield (
            f"the main target leaves its image at {len(lost)} of "
            f"{len(calibration_plan.positions_deg)} head positions, e.g. at "
            f"pan {lost[0][0]:.2f} tilt {lost[0][1]:.2f} deg: turn less far"
        )
    if view.square_px < FEW_PX_SQUARE:
        yield (
            f"a square is only {view.square_px:.1f} px, {FEW_PX_SQUARE:.0f} px are needed: larger "
            "squares, a longer sub lens, or the board nearer"
        )
    if view.disc_px < FEW_PX_DISC:
        yield (
            f"a disc is only {view.disc_px:.1f} px across, {FEW_PX_DISC:.0f} px are needed: larger "
            "discs or a longer main lens"
        )
    yield from _border_warnings(planned)
    if view.affine_error_px >= AFFINE_LIMIT_PX:
        yield (
            f"Eq. 5 fails ({view.affine_error_px:.1f} px for {limits.expected_drift_mm:g} mm along "
            "the view): calibrate with --method rigid, not paper"
        )


def _whole(planned: PlannedSite, position: tuple[float, float]) -> BoolArray:
    """Which discs are wholly in the main image at a head position."""
    return planned.predict_discs(planned.head_motion(position)).found


def _border_warnings(planned: PlannedSite) -> Iterator[str]:
    """Where no border of the board is in view, a motion of two squares looks like none."""
    site, board = planned.site, planned.board
    target = site.sub_target
    seen = planned.predict_board(planned.T_CS1_WS).view.index
    if len(seen) == 0:
        yield "no corner of the board is in the sub image: check [target.sub] distance_mm and lens"
        return
    j, i = np.divmod(seen, board.columns)
    size_mm = np.array([target.squares_x, target.squares_y]) * target.square_mm
    field_mm = np.array([site.sub.width_px, site.sub.height_px]) * (
        target.distance_mm / site.sub.focal_px
    )
    for name, places, count, whole, field in zip(
        ("left or right", "top or bottom"),
        (i, j),
        (board.columns, board.rows),
        size_mm,
        field_mm,
        strict=True,
    ):
        hidden = count - len(np.unique(places))
        if whole > field and hidden > 1:
            yield (
                f"no border of the board in view at {name} ({whole:.0f} mm of board in "
                f"{field:.0f} mm of view): a shift by two squares, {2 * target.square_mm:g} mm, "
                "looks like none; a smaller board or a wider view shows which part is seen"
            )
