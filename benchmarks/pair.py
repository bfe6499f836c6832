"""What one full-size frame pair costs on one core, beside decoding it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import CalibrationView, ViewRole, calibrate
from core.images import GreyImage
from core.measurement import measure_pair
from core.site import ExtraTarget, TargetRole
from daemon.config.reading import load_config
from drivers.png import encode_png
from drivers.protocols import Image, Role
from drivers.sim.settings import SimPlate, SimSettings
from drivers.sim.world import World

CONFIG = Path(__file__).parents[1] / "config.example.toml"
START_UTC = datetime(2026, 3, 1, tzinfo=UTC)
CALIBRATION_UTC = START_UTC - timedelta(hours=1)
LENS_VIEWS = 12
PAN_TILT_DEG = (-0.2, -0.1, 0.0, 0.1, 0.2)
PAIRS = 12
ROLES: tuple[Role, Role] = ("main", "sub")


@dataclass(frozen=True, slots=True)
class PairCost:
    """Medians over the pairs, CPU seconds of one core, and the error against the truth."""

    measure_s: float
    decode_s: float
    """Both PNGs, by cv2.imdecode."""
    corners: int
    width_px: int
    height_px: int
    rms_error_mm: float
    rms_false_mm: float


def measure_cost() -> PairCost:
    """Calibrate on a simulated full-size site, then time its frame pairs."""
    site = load_config(CONFIG).site()
    world = World(site, SimSettings(start_utc=START_UTC))
    calibration, _ = calibrate(calibration_views(world), site)
    measure_s, decode_s, errors, false = [], [], [], []
    corners = 0
    for number in range(PAIRS + 1):
        now = START_UTC + timedelta(minutes=45 * number + 30)
        main, sub = world.render("main", now), world.render("sub", now)
        started_s = time.process_time()
        result = measure_pair(GreyImage(main), GreyImage(sub), site, calibration)
        seconds = time.process_time() - started_s
        if number == 0:
            continue  # the first pair loads the compiled loops
        if result.corrected is None:
            msg = f"a pair of {now} was not measured: {', '.join(result.reasons)}"
            raise RuntimeError(msg)
        truth = world.truth(now)
        measure_s.append(seconds)
        decode_s.append(decode_cost(main, sub))
        errors.append(result.corrected.mm - truth.displacement_mm)
        false.append(truth.false_mm)
        corners = result.diagnostics.corners_used
    return PairCost(
        statistics.median(measure_s),
        statistics.median(decode_s),
        corners,
        site.main.width_px,
        site.main.height_px,
        rms(errors),
        rms(false),
    )


def further_target_cost() -> tuple[float, float]:
    """CPU seconds of a pair with one further target in the main image, and of the same without."""
    config = load_config(CONFIG).site()
    drawn = config.main_target
    half = replace(drawn, centres_mm=drawn.centres_mm / 2, diameters_mm=drawn.diameters_mm / 2)
    site = replace(config, extra_targets=(ExtraTarget("abutment", TargetRole.FIXED, half),))
    plate = SimPlate("abutment", offset_mm=(50.0, 0.0))
    world = World(site, SimSettings(start_utc=START_UTC, plates=(plate,)))
    calibration, _ = calibrate(calibration_views(world), site)
    alone = replace(calibration, calibrated=replace(calibration.calibrated, further=()))
    with_s: list[float] = []
    without_s: list[float] = []
    for number in range(PAIRS + 1):
        now = START_UTC + timedelta(minutes=45 * number + 30)
        images = [GreyImage(world.render(role, now)) for role in ROLES]
        for seconds, given, used in ((with_s, site, calibration), (without_s, config, alone)):
            started_s = time.process_time()
            result = measure_pair(images[0], images[1], given, used)
            seconds.append(time.process_time() - started_s)
            if len(result.targets) != len(given.extra_targets) or result.corrected is None:
                msg = f"a pair of {now} was not measured: {', '.join(result.reasons)}"
                raise RuntimeError(msg)
    # The first pair loads the compiled loops.
    return statistics.median(with_s[1:]), statistics.median(without_s[1:])


def calibration_views(world: World) -> list[CalibrationView]:
    """Render lens views, the reference and rig positions, in this order, the site at rest."""
    views = []
    for number in range(LENS_VIEWS):
        world.hold_board(number)
        views.append(view(world, ViewRole.INTRINSICS))
    world.hold_board(None)
    views.append(view(world, ViewRole.REFERENCE))
    for pan_deg in PAN_TILT_DEG:
        for tilt_deg in PAN_TILT_DEG:
            world.turn_head(pan_deg, tilt_deg)
            views.append(view(world, ViewRole.RIG))
    world.turn_head(0.0, 0.0)
    return views


def view(world: World, role: ViewRole) -> CalibrationView:
    """Render one calibration view."""
    lens_only = role is ViewRole.INTRINSICS
    return CalibrationView(
        role.value,
        role,
        None if lens_only else GreyImage(world.render("main", CALIBRATION_UTC)),
        GreyImage(world.render("sub", CALIBRATION_UTC)),
    )


def decode_cost(main: Image, sub: Image) -> float:
    """CPU seconds to decode both images from PNG."""
    files = [np.frombuffer(encode_png(image), np.uint8) for image in (main, sub)]
    started_s = time.process_time()
    for data in files:
        cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return time.process_time() - started_s


def rms(vectors: Sequence[FloatArray]) -> float:
    """Root mean square length."""
    return float(np.sqrt(np.mean([v @ v for v in vectors])))
