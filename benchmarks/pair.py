"""What one full-size frame pair costs on one core, beside decoding it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import CalibrationView, ViewRole, calibrate
from core.images import GreyImage
from core.measurement import measure_pair
from daemon.config.reading import load_config
from drivers.png import encode_png
from drivers.protocols import Image
from drivers.sim.settings import SimSettings
from drivers.sim.world import World

CONFIG = Path(__file__).parents[1] / "config.example.toml"
START_UTC = datetime(2026, 3, 1, tzinfo=UTC)
CALIBRATION_UTC = START_UTC - timedelta(hours=1)
LENS_VIEWS = 12
PAN_TILT_DEG = (-0.2, -0.1, 0.0, 0.1, 0.2)
PAIRS = 12


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
