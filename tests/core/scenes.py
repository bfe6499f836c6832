"""Small sites for the tests of the core: the laboratory's physics on fewer pixels, with views."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import CalibrationView, ViewRole
from core.images import GreyImage
from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    QualityLimits,
    RigPrior,
    Site,
)
from drivers.protocols import Role
from drivers.sim.frameset_writer import head_reach_deg
from drivers.sim.settings import SimSettings
from drivers.sim.world import World

CENTRES_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
MINUTE = timedelta(minutes=1)


def small_site(distance_mm: float = 11000.0, **changes: object) -> Site:
    """A site with 6 px/mm on the main target at 11 m and 20 px per square of the board.

    The board is a little taller than the sub image and narrower, as on a real pier.
    """
    scale = distance_mm / 11000.0
    made = Site(
        main=CameraGeometry(640, 400, 11.72, 800.0),
        sub=CameraGeometry(480, 300, 11.72, 6.0),
        main_target=CirclesTarget(CENTRES_MM * scale, np.full(5, 8.0 * scale), distance_mm, 20.0),
        sub_target=CheckerboardTarget(22, 15, 2.0, 50.0),
        rig=RigPrior(np.array([0.0, 180.0, 0.0]), 1.0, np.array([0.0, 0.0, -80.0]), 3.0),
        quality=QualityLimits(),
    )
    return replace(made, **changes)


def grey(world: World, role: Role, t_utc: datetime) -> GreyImage:
    """What a camera sees."""
    return GreyImage(world.render(role, t_utc), world.settings.sensor.bits)


def lens_views(world: World, count: int) -> list[CalibrationView]:
    """Views of the board held by hand."""
    views = []
    for k in range(count):
        world.hold_board(k)
        image = grey(world, "sub", world.settings.start_utc - (200 + k) * MINUTE)
        views.append(CalibrationView(f"lens {k}", ViewRole.INTRINSICS, None, image))
    world.hold_board(None)
    return views


def reference_utc(settings: SimSettings) -> datetime:
    """When the reference is taken: everything at rest."""
    return settings.start_utc - 100 * MINUTE


def head_positions(site: Site, count: int) -> FloatArray:
    """Pan and tilt (count, 2), degrees, over most of the main camera's field of view."""
    reach = 0.8 * np.array(head_reach_deg(site))
    return np.random.default_rng(7).uniform(-reach, reach, (count, 2))


def rest_views(world: World, positions_deg: FloatArray) -> list[CalibrationView]:
    """The reference, and rig positions with both targets at rest."""
    start = reference_utc(world.settings)
    views = []
    for k, (pan_deg, tilt_deg) in enumerate([(0.0, 0.0), *positions_deg]):
        world.turn_head(pan_deg, tilt_deg)
        main, sub = (grey(world, role, start + k * MINUTE) for role in ("main", "sub"))
        role = ViewRole.RIG if k else ViewRole.REFERENCE
        views.append(CalibrationView(f"rig {k}" if k else "reference", role, main, sub))
    world.turn_head(0.0, 0.0)
    return views
