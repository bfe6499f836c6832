"""How true sigma is over many rendered seasons, each with a calibration of its own.

    python -m benchmarks.season_sigma --sites 12
    python -m benchmarks.season_sigma --sites 20 --without-fixed

The rows of one calibration share its error: fourteen rows are one trial of that, and fourteen of
the pixels' noise. So the common offset of a season's rows and their scatter about it are judged
apart, each against its own part of sigma. Small images; how the rig bends and creeps by the seed.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial

import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import CalibrationView, ViewRole, calibrate
from core.images import GreyImage
from core.measurement import measure_pair
from core.moment import Moment
from core.results import Flag
from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    ExtraTarget,
    QualityLimits,
    RigPrior,
    Site,
    TargetRole,
)
from drivers.sim.frameset_writer import head_reach_deg
from drivers.sim.settings import Breathing, Climate, Motion, Scenario, SimPlate, SimSettings
from drivers.sim.world import World

DAYS, LENS_VIEWS, RIG_VIEWS = 145.0, 10, 13
"""As the season that docs/method.md shows."""
_CENTRES_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
_MINUTE = timedelta(minutes=1)
_PLATE_MM = (108.0, 30.0)
"""Of the fixed plate's middle beside the main target's, at 22 m."""


@dataclass(frozen=True, slots=True)
class Season:
    """The rows of one calibration that were measured, less the truth."""

    seed: int
    error_mm: FloatArray
    """(n, 2)."""
    covariance_mm2: FloatArray
    """(n, 2, 2) of the whole."""
    shared_mm2: FloatArray
    """(n, 2, 2) the part that every frame of a slot has alike: the calibration's."""
    good: int


def make(seed: int, *, fixed: bool) -> tuple[Site, SimSettings]:
    """A site at 22 m on fewer pixels, that bends in a direction of its own."""
    rng = np.random.default_rng([seed, 91])
    near = CirclesTarget(2.0 * _CENTRES_MM, np.full(5, 16.0), 22000.0, 20.0)
    beside = CirclesTarget(1.0 * _CENTRES_MM, np.full(5, 8.0), 21500.0, 20.0)
    extra = ExtraTarget("abutment", TargetRole.FIXED, beside)
    site = Site(
        CameraGeometry(960, 600, 11.72, 800.0),
        CameraGeometry(640, 400, 11.72, 6.0),
        near,
        CheckerboardTarget(29, 21, 2.0, 50.0),
        RigPrior(np.array([0.0, 180.0, 0.0]), 1.0, np.array([0.0, 0.0, -80.0]), 3.0),
        QualityLimits(),
        extra_targets=(extra,) if fixed else (),
    )
    turn, shift = rng.uniform(0.0, 2.0 * np.pi, 2)
    settings = SimSettings(
        seed=seed,
        scenarios=(Scenario("drift"), Scenario("bridge")),
        motion=Motion(drift_mrad=0.3, drift_mm=1.0, bridge_daily_mm=5.0),
        climate=Climate(air_daily_k=6, air_seasonal_k=12, air_weather_k=3, camera_lag_h=1),
        breathing=Breathing(
            cameras_urad_per_k=(2.0 * np.cos(turn), 2.0 * np.sin(turn), 0.5),
            cameras_urad_per_sqrt_day=(1.17, 1.17, 0.3),
            main_px_per_k=(0.01 * np.cos(shift), 0.01 * np.sin(shift)),
        ),
        plates=(SimPlate("abutment", offset_mm=_PLATE_MM),) if fixed else (),
    )
    return site, settings


def run(rows: int, fixed: bool, seed: int) -> Season:  # noqa: FBT001 - of `partial`
    """Calibrate one site and measure its season."""
    site, settings = make(seed, fixed=fixed)
    world, rng = World(site, settings), np.random.default_rng([seed, 92])
    reference_utc = settings.start_utc - 100 * _MINUTE
    views = []
    for k in range(LENS_VIEWS):
        world.hold_board(k)
        sub = GreyImage(world.render("sub", settings.start_utc - (200 + k) * _MINUTE))
        views.append(CalibrationView(f"lens {k}", ViewRole.INTRINSICS, None, sub))
    world.hold_board(None)
    reach_deg = 0.8 * np.array(head_reach_deg(site))
    for k in range(RIG_VIEWS + 1):
        world.turn_head(*(rng.uniform(-reach_deg, reach_deg) if k else np.zeros(2)))
        t_utc = reference_utc + k * _MINUTE
        main, sub = (GreyImage(world.render(role, t_utc)) for role in ("main", "sub"))
        role = ViewRole.RIG if k else ViewRole.REFERENCE
        views.append(CalibrationView(f"rig {k}", role, main, sub))
    world.turn_head(0.0, 0.0)
    warm = Moment(reference_utc.timestamp(), world.reported_c("main", reference_utc))
    calibration = replace(calibrate(views, site)[0], reference=warm)
    errors, wholes, shared, good = [], [], [], 0
    for row in range(rows):
        days = DAYS * (row + 0.3) / rows
        t_utc = settings.start_utc + timedelta(days=days, hours=float(rng.uniform(0.0, 24.0)))
        main, sub = (GreyImage(world.render(role, t_utc)) for role in ("main", "sub"))
        moment = Moment(t_utc.timestamp(), world.reported_c("main", t_utc))
        found = measure_pair(main, sub, site, calibration, moment=moment)
        good += found.flag is Flag.GOOD
        if found.corrected is None or found.corrected.shared_mm2 is None:
            continue
        errors.append(found.corrected.mm - world.truth(t_utc, reference_utc).displacement_mm)
        wholes.append(found.corrected.covariance_mm2)
        shared.append(found.corrected.shared_mm2)
    return Season(seed, np.array(errors), np.array(wholes), np.array(shared), good)


def line(seasons: list[Season]) -> str:
    """What the errors of seasons are in units of their sigma: all, the common part, the scatter."""
    z, offsets, scatter = [], [], []
    for one in seasons:
        n = len(one.error_mm)
        whole = np.diagonal(one.covariance_mm2, axis1=1, axis2=2)
        shared = np.diagonal(one.shared_mm2, axis1=1, axis2=2)
        own = np.maximum(whole - shared, 1e-12)
        z.append(one.error_mm / np.sqrt(whole))
        mean = one.error_mm.mean(axis=0)
        # Were the shared part the same error in each row: its mean variance, and the pixels' of n.
        offsets.append(mean / np.sqrt(shared.mean(axis=0) + own.mean(axis=0) / n))
        scatter.append((one.error_mm - mean) / np.sqrt(own * (1.0 - 1.0 / n)))
    everything, common = np.concatenate(z), np.array(offsets)
    within = np.concatenate(scatter)
    errors = np.concatenate([one.error_mm for one in seasons])
    inside = [(np.abs(everything) < k).mean() for k in (1.0, 2.0)]
    return (
        f"rms {np.sqrt((errors**2).mean()):.5f} mm, z rms {_rms(everything)}, "
        f"within 1 sigma {inside[0]:.0%}, 2 sigma {inside[1]:.0%}; common offset {_rms(common)}, "
        f"scatter about it by the pixels' part {_rms(within)}"
    )


def _rms(z: FloatArray) -> str:
    x, y = np.sqrt((z**2).mean(axis=0))
    return f"{np.sqrt((z**2).mean()):.2f} ({x:.2f} {y:.2f})"


def main() -> None:
    """Print a line for each season and one for all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sites", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rows", type=int, default=6)
    parser.add_argument("--without-fixed", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    seeds = range(asked.seed, asked.seed + asked.sites)
    seasons = []
    with ProcessPoolExecutor(asked.jobs) as pool:
        for season in pool.map(partial(run, asked.rows, not asked.without_fixed), seeds):
            seasons.append(season)
            print(season.seed, f"{season.good} good;", line([season]), flush=True)
    print("all", line(seasons))


if __name__ == "__main__":
    main()
