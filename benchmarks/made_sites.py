"""Simulated sites of many kinds, and what is seen of them without images: points with noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from core.calibration.calibrate import Method, ViewRole
from core.calibration.joint_fit import Fit, FitOptions, build_calibrated_site, fit_views
from core.calibration.lens_selection import start_from_views
from core.calibration.views import LensView, PairView, Views
from core.checkerboard.board import Board
from core.checkerboard.corners import LocatedBoard
from core.checkerboard.resection import BoardView
from core.discs.disc_finder import Discs
from core.images import GreyImage
from core.rig.calibrated_site import CalibratedSite
from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    QualityLimits,
    RigPrior,
    Site,
)
from drivers.sim.frameset_writer import head_reach_deg
from drivers.sim.geometry import held_board_pose
from drivers.sim.head import SimulatedHead
from drivers.sim.settings import AsBuilt, Motion, Print, Scenario, SimSettings
from drivers.sim.world import World

Kind = Literal["lab", "field"]
START_UTC = datetime(2026, 3, 1, tzinfo=UTC)
REST_UTC = START_UTC - timedelta(hours=3)
RIG_VIEWS, ROWS = 21, 12
LENS_VIEWS = {"lab": 12, "field": 10}
REACH = 0.8
"""Share of the way to where the main target would touch the edge of its image."""
MARGIN_PX = 2.0
NOISE_DN, CONTRAST_DN, BLUR_PX = 1.0, 175.0, 0.85
"""As the simulated cameras have them: grey noise, white less black, blur with the pixel's."""
_NO_IMAGE = GreyImage(np.zeros((1, 1), np.uint8))


@dataclass(frozen=True, slots=True)
class Case:
    """What kind of sites to make."""

    kind: Kind
    print_um: float = 4.0
    """rms of each printed line's position."""
    bow_um: float = 25.0
    corner_um: float = 0.0
    """rms of an error of each corner of its own; without images only."""
    distance_mm: float | None = None
    """None: 11 m in the laboratory, 22 m in the field."""
    shrink: float = 1.0
    """Fewer pixels in both images and on both targets, for a quick look."""
    quiet_rows: bool = False
    """Rows without image noise: their errors, and the sigma here, are the calibration's alone."""


def make_site(case: Case, seed: int) -> tuple[Site, SimSettings]:
    """A site as drawn, and how it was built: lens, board and distortion by the seed."""
    rng = np.random.default_rng([seed, 77])
    distance_mm = case.distance_mm or {"lab": 11000.0, "field": 22000.0}[case.kind]
    scale, shrink = distance_mm / 11000.0, case.shrink
    width_px, height_px, pitch_um = round(1920 / shrink), round(1200 / shrink), 5.86 * shrink
    focal_mm = rng.uniform(5.0, 8.0)
    square_mm = rng.uniform(1.5, 3.0) * shrink
    view_mm = np.array([width_px, height_px]) * pitch_um * 1e-3 * 50.0 / focal_mm
    across, down = np.round(view_mm * [rng.uniform(0.65, 1.0), rng.uniform(0.95, 1.1)] / square_mm)
    centres_mm = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
    site = Site(
        CameraGeometry(width_px, height_px, pitch_um, 800.0),
        CameraGeometry(width_px, height_px, pitch_um, focal_mm),
        CirclesTarget(centres_mm * scale, np.full(5, 8.0 * scale), distance_mm, 20.0),
        CheckerboardTarget(int(across), int(down), square_mm, 50.0),
        RigPrior(np.array([0.0, 180.0, 0.0]), 1.0, np.array([0.0, 0.0, -80.0]), 3.0),
        QualityLimits(),
    )
    bend = rng.uniform(-0.3, 1.8)
    settings = SimSettings(
        seed=seed,
        start_utc=START_UTC,
        scenarios=() if case.kind == "lab" else (Scenario("drift"), Scenario("bridge")),
        motion=Motion(drift_mrad=1.6, drift_mm=2.4, bridge_daily_mm=10.0),
        print=Print(line_error_um=case.print_um, scale_error=0.0008, bow_um=case.bow_um),
        as_built=AsBuilt(sub_distortion=(-0.1 * bend, 0.03 * bend, 3e-4, -2e-4, -0.004 * bend)),
    )
    return site, settings


@dataclass(frozen=True, slots=True)
class Shot:
    """When a pair is taken, and where head and board are."""

    role: ViewRole | None
    """None: to be measured."""
    utc: datetime
    held: int | None = None
    head_deg: tuple[float, float] = (0.0, 0.0)


def shots(case: Case, site: Site, seed: int) -> Iterator[Shot]:
    """Lens views, the reference, rig positions, rows: in the laboratory the head moves the rows."""
    rng = np.random.default_rng([seed, 78])
    reach_deg = np.minimum(REACH * np.array(head_reach_deg(site)), 4.0)

    def anywhere() -> tuple[float, float]:
        pan_deg, tilt_deg = rng.uniform(-reach_deg, reach_deg)
        return float(pan_deg), float(tilt_deg)

    minute = timedelta(minutes=1)
    for number in range(LENS_VIEWS[case.kind]):
        yield Shot(ViewRole.INTRINSICS, REST_UTC + number * minute, held=number)
    yield Shot(ViewRole.REFERENCE, REST_UTC + 20 * minute)
    for number in range(RIG_VIEWS):
        yield Shot(ViewRole.RIG, REST_UTC + (21 + number) * minute, head_deg=anywhere())
    for number in range(ROWS):
        still = case.kind == "field"
        yield Shot(
            None,
            START_UTC + (120 + 97 * number) * minute,
            head_deg=(0.0, 0.0) if still else anywhere(),
        )


class SeenWorld:
    """A world seen without images: true points with noise of a known covariance."""

    def __init__(self, world: World, case: Case) -> None:
        self.world, self.site, self._quiet_rows = world, world.site, case.quiet_rows
        self._rng = np.random.default_rng([world.settings.seed, 79])
        target = self.site.sub_target
        crossings = world.geometry.board.corners_mm()[1:-1, 1:-1].reshape(-1, 3)
        shape = (target.squares_x - 1) * (target.squares_y - 1), 2
        crossings[:, :2] += case.corner_um * 1e-3 * self._rng.normal(size=shape)
        self.corners_mm = crossings

    def board(self, shot: Shot) -> LocatedBoard:
        """The corners in the image."""
        geometry, site = self.world.geometry, self.site
        if shot.held is not None:
            rng = np.random.default_rng([self.world.settings.seed, 4, shot.held])
            pose = held_board_pose(site, geometry, rng)
        else:
            pose = self.world.truth(shot.utc).motion.compose(geometry.T_CS_WS)
        true_px = geometry.sub.project(pose.apply(self.corners_mm))
        size_px = np.array([site.sub.width_px, site.sub.height_px]) - 1.0 - MARGIN_PX
        index = np.nonzero(((true_px > MARGIN_PX) & (true_px < size_px)).all(axis=1))[0]
        square_px = site.sub.focal_px * site.sub_target.square_mm / pose.t_mm[2]
        sigma_px = _edge_sigma_px(0.92 * square_px)
        noise_px = self._noise(shot) * sigma_px
        noisy = true_px[index] + noise_px * self._rng.normal(size=(len(index), 2))
        covariance = np.tile(sigma_px**2 * np.eye(2), (len(index), 1, 1))
        view = BoardView(index, noisy, covariance)
        return LocatedBoard(
            view,
            unambiguous=True,
            white_dn=np.full(len(index), CONTRAST_DN),
            black_dn=np.zeros(len(index)),
            missing_px=np.zeros((0, 2)),
            noise_dn=NOISE_DN,
            contrast_dn=CONTRAST_DN,
            blur_px=BLUR_PX,
        )

    def discs(self, shot: Shot) -> Discs:
        """The discs' centres."""
        true_px = self.world.disc_centres_px(shot.utc)
        radius_px = 0.5 * self.site.main_target.diameters_mm.max() * self.site.nominal_px_per_mm
        sigma_px, n = _edge_sigma_px(math.pi * radius_px), len(true_px)
        noisy = true_px + self._noise(shot) * sigma_px * self._rng.normal(size=true_px.shape)
        covariance = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
        return Discs(np.ones(n, bool), noisy, covariance, np.ones(n), CONTRAST_DN, BLUR_PX)

    def _noise(self, shot: Shot) -> float:
        return 0.0 if self._quiet_rows and shot.role is None else 1.0

    def pair(self, name: str, shot: Shot) -> PairView:
        """Both targets."""
        return PairView(name, _NO_IMAGE, self.board(shot), self.discs(shot))


def _edge_sigma_px(edge_px: float) -> float:
    """Cramer-Rao bound across a blurred edge of this length, 1 sigma."""
    information = CONTRAST_DN**2 * edge_px / (2.0 * math.sqrt(math.pi) * BLUR_PX)
    return NOISE_DN / math.sqrt(information)


@dataclass(frozen=True, slots=True)
class NumbersSite:
    """A site calibrated without images, and pairs to be measured."""

    site: Site
    world: World
    head: SimulatedHead
    calibrated: CalibratedSite
    pairs: tuple[tuple[Shot, PairView], ...]


def make_numbers(case: Case, seed: int) -> NumbersSite:
    """Make a site and calibrate it, all points with noise of a known covariance."""
    site, settings = make_site(case, seed)
    world = World(site, settings, renders=False)
    head, seen = SimulatedHead(world), SeenWorld(world, case)
    lens: list[LensView] = []
    pairs: dict[ViewRole | None, list[tuple[Shot, PairView]]] = {r: [] for r in (*ViewRole, None)}
    for number, shot in enumerate(shots(case, site, seed)):
        head.move_to(*shot.head_deg)
        if shot.role is ViewRole.INTRINSICS:
            lens.append(LensView(str(number), _NO_IMAGE, seen.board(shot)))
        else:
            pairs[shot.role].append((shot, seen.pair(str(number), shot)))
    rig = tuple(view for _, view in pairs[ViewRole.RIG])
    views = Views(pairs[ViewRole.REFERENCE][0][1], rig, tuple(lens))
    return NumbersSite(site, world, head, calibrate_numbers(views, site)[0], tuple(pairs[None]))


def quiet_pairs(made: NumbersSite, case: Case) -> tuple[tuple[Shot, PairView], ...]:
    """A site's pairs to be measured, seen once more without noise."""
    seen, pairs = SeenWorld(made.world, replace(case, quiet_rows=True)), []
    for shot, pair in made.pairs:
        made.head.move_to(*shot.head_deg)
        pairs.append((shot, seen.pair(pair.name, shot)))
    return tuple(pairs)


def calibrate_numbers(views: Views, site: Site) -> tuple[CalibratedSite, Fit]:
    """Calibrate from located points."""
    options = FitOptions(site, Board.nominal(site.sub_target), Method.RIGID, skew=False)
    start, _ = start_from_views(views, options)
    fit = fit_views(views, start.lens, options)
    return build_calibrated_site(fit, options), fit
