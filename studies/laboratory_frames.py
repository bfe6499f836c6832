"""The paper's laboratory test, rendered, and its frames as dcam and as OpenCV locate them."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import cv2
import numpy as np

from core.arrays import FloatArray
from core.calibration.joint_fit import FitOptions, Method, build_calibrated_site, fit_views
from core.calibration.lens_selection import start_from_views
from core.calibration.views import (
    CalibrationView,
    LensView,
    PairView,
    ViewRole,
    Views,
    find_targets,
    relocate_corners,
)
from core.checkerboard.board import Board
from core.checkerboard.resection import resect
from core.images import GreyImage
from core.lens_model import LensModel
from core.rig.calibrated_site import CalibratedSite
from core.rig.compensation import affine
from core.rig.propagation import predict_shift
from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    QualityLimits,
    RigPrior,
    Site,
)
from drivers.sim.settings import SimSettings
from drivers.sim.world import World

SEED = 11
POSITIONS, LENS_VIEWS = 21, 12
WIDEST_MM, TALLEST_MM = 44.0, 25.0
"""False displacement that the head makes, across and up."""
DISTANCE_MM = 11_000.0
START_UTC = datetime(2026, 3, 1, tzinfo=UTC)
OPENCV_SIGMA_PX = 0.05
"""1 sigma that the fit is told of OpenCV's corners and discs."""
HALF_WINDOW_PX = 11
"""Of `cornerSubPix`, as its documentation has it."""


def site_of(shrink: float = 1.0) -> Site:
    """The paper's Table 3, as drawn."""
    width_px, height_px, pitch_um = round(1920 / shrink), round(1200 / shrink), 5.86 * shrink
    centres_mm = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
    return Site(
        CameraGeometry(width_px, height_px, pitch_um, 800.0),
        CameraGeometry(width_px, height_px, pitch_um, 6.0),
        CirclesTarget(centres_mm, np.full(5, 8.0), DISTANCE_MM, 20.0),
        CheckerboardTarget(round(32 / shrink), round(31 / shrink), 2.0 * shrink, 50.0),
        RigPrior(np.array([0.0, 180.0, 0.0]), 1.0, np.array([0.0, 0.0, -80.0]), 3.0),
        QualityLimits(),
        LensModel.BROWN,
    )


def head_positions_deg(count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Pan and tilt of the calibration (anywhere), then of the test (across, up and down)."""
    reach_deg = np.degrees(np.array([WIDEST_MM, TALLEST_MM]) / DISTANCE_MM)
    anywhere = rng.uniform(-1.0, 1.0, (count, 2))
    across = np.linspace(-1.0, 1.0, count)
    test = np.column_stack([across, np.sin(2.5 * math.pi * across)])
    return anywhere * reach_deg, test * reach_deg


def rendered(site: Site, positions: int, lens_views: int, seed: int) -> list[CalibrationView]:
    """Lens views, the reference, the calibration's positions, then the test's; all at rest."""
    world = World(site, SimSettings(seed=seed, start_utc=START_UTC, scenarios=()))
    calibration, test = head_positions_deg(positions, np.random.default_rng([seed, 41]))
    views: list[CalibrationView] = []

    def take(name: str, role: ViewRole) -> None:
        utc = START_UTC + timedelta(minutes=len(views))
        sub = GreyImage(world.render("sub", utc))
        lens = role is ViewRole.INTRINSICS
        views.append(
            CalibrationView(name, role, None if lens else GreyImage(world.render("main", utc)), sub)
        )

    for number in range(lens_views):
        world.hold_board(number)
        take(f"lens {number}", ViewRole.INTRINSICS)
    world.hold_board(None)
    take("reference", ViewRole.REFERENCE)
    for name, heads in (("rig", calibration), ("test", test)):
        for number, (pan_deg, tilt_deg) in enumerate(heads):
            world.turn_head(pan_deg, tilt_deg)
            take(f"{name} {number}", ViewRole.RIG)
    return views


def located_by_opencv(seen: Views, images: dict[str, GreyImage], site: Site) -> tuple[Views, float]:
    """The same views with OpenCV's corners and discs, and the CPU time of a pair.

    Which corner is which, and where about it is, is given to OpenCV to a whole pixel.
    """
    started_s = time.process_time()

    def board(view: LensView) -> LensView:
        found = view.board.view
        start = np.round(found.points_px).astype(np.float32).reshape(-1, 1, 2)
        half = min(HALF_WINDOW_PX, round(0.4 * _square_px(site)))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
        refined = cv2.cornerSubPix(view.sub.pixels, start, (half, half), (-1, -1), stop)
        covariance = np.tile(OPENCV_SIGMA_PX**2 * np.eye(2), (len(start), 1, 1))
        points_px = np.asarray(refined.reshape(-1, 2), dtype=np.float64)
        located = replace(found, points_px=points_px, covariance_px2=covariance)
        return replace(view, board=replace(view.board, view=located))

    def pair(view: PairView) -> PairView:
        discs, image = view.discs, images[view.name]
        covariance = np.tile(OPENCV_SIGMA_PX**2 * np.eye(2), (len(discs.found), 1, 1))
        points_px = ellipses_px(image, discs.points_px)
        seen_again = replace(discs, points_px=points_px, covariance_px2=covariance)
        return PairView(view.name, view.sub, board(view).board, seen_again)

    views = Views(
        pair(seen.reference), tuple(map(pair, seen.rig)), tuple(board(v) for v in seen.lens)
    )
    return views, (time.process_time() - started_s) / (1 + len(seen.rig) + len(seen.lens))


def ellipses_px(image: GreyImage, about_px: FloatArray) -> FloatArray:
    """Disc centres (n, 2) by Otsu's threshold, contours and `fitEllipse`."""
    _, white = cv2.threshold(image.pixels, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(white, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    fits = np.array([cv2.fitEllipse(contour)[0] for contour in contours if len(contour) > 20])
    away = np.hypot(*(fits[None] - about_px[:, None]).transpose(2, 0, 1))
    return np.asarray(fits[np.argmin(away, axis=1)], dtype=np.float64)


def _square_px(site: Site) -> float:
    target = site.sub_target
    return target.square_mm * site.sub.focal_px / target.distance_mm


@dataclass(frozen=True, slots=True)
class Located:
    """The frames, and where dcam finds targets in them."""

    site: Site
    options: FitOptions
    images: dict[str, GreyImage]
    """Of the main camera, by the view's name."""
    views: Views
    rejected: list[str]
    locating_s: float
    """CPU time of a pair."""

    def errors_mm(self, views: Views, method: Method) -> list[list[float]]:
        """Fit to all views but those of the test; the errors at these, (positions, 2)."""
        asked = replace(self.options, method=method)
        test = tests_of(views)
        fitted = views.without({view.name for view in test})
        first, _ = start_from_views(fitted, asked)
        calibrated = build_calibrated_site(fit_views(fitted, first.lens, asked), asked)
        return [_corrected_mm(calibrated, view) for view in test]


def locate(positions: int, lens_views: int, seed: int, shrink: float = 1.0) -> Located:
    """Render the frames and find the targets."""
    site = site_of(shrink)
    options = FitOptions(site, Board.nominal(site.sub_target), Method.RIGID, skew=False)
    taken = rendered(site, positions, lens_views, seed)
    images = {view.name: view.main for view in taken if view.main is not None}
    # Twice, and the second is timed: the first may have compiled loops.
    for _ in range(2):
        started_s = time.process_time()
        seen, rejected = find_targets(taken, site)
        start, _ = start_from_views(seen, options)
        views, unlike = relocate_corners(seen, start.lens, options.board)
        locating_s = (time.process_time() - started_s) / len(taken)
    names = [name for name, _ in (*rejected, *unlike)]
    return Located(site, options, images, views, names, locating_s)


def tests_of(views: Views) -> list[PairView]:
    """The positions of the test."""
    return [view for view in views.rig if view.name.startswith("test")]


def compute(positions: int, lens_views: int, seed: int, shrink: float = 1.0) -> dict[str, Any]:
    """Errors (mm) of the test positions by detector and method, their raw values, and times."""
    ours = locate(positions, lens_views, seed, shrink)
    theirs, theirs_s = located_by_opencv(ours.views, ours.images, ours.site)
    result: dict[str, Any] = {"rejected": ours.rejected, "errors": {}}
    for detector, views, seconds in (
        ("dcam", ours.views, ours.locating_s),
        ("OpenCV", theirs, theirs_s),
    ):
        for method in (Method.PAPER, Method.RIGID):
            found = {"mm": ours.errors_mm(views, method), "locating_s": seconds}
            result["errors"][f"{detector}, {method.value}"] = found
    return result | {"raw": _raw_mm(ours.site, theirs)}


def _corrected_mm(calibrated: CalibratedSite, view: PairView) -> list[float]:
    """Displacement (2,) of a target that rested, without the false one: the error."""
    pose = resect(calibrated.lens, calibrated.corners_mm, view.board.view).pose
    motion = pose.compose(calibrated.reference_pose.inverse())
    shift_px = predict_shift(calibrated.model, calibrated.reference_discs_px, motion).shift_px
    left_px = view.discs.points_px - calibrated.reference_discs_px - shift_px
    mm: list[float] = np.linalg.solve(calibrated.B, left_px.mean(axis=0)).tolist()
    return mm


def _raw_mm(site: Site, views: Views) -> list[list[float]]:
    """What the main camera alone says at the positions of the test, (positions, 2)."""
    reference_px = views.reference.discs.points_px
    B = affine(site.main_target.centres_mm, reference_px)[0]
    moved_px = [(view.discs.points_px - reference_px).mean(axis=0) for view in tests_of(views)]
    mm: list[list[float]] = np.linalg.solve(B, np.array(moved_px).T).T.tolist()
    return mm
