"""How true sigma is over many rendered seasons, each with two calibrations of its own.

    python -m benchmarks.season_sigma --sites 20

The rows of one calibration share its error: fourteen rows are one trial of that, and fourteen of
the pixels' noise. So the common offset of a season's rows and their scatter about it are judged
apart, each against its own part of sigma. Small images. Each rig bends, creeps and warms by amounts
of its own, drawn from the stability budget that its sigma rests on. The same images are measured
with the fixed plate and with its entry left out of the config. After the season the site is
calibrated again, and the rows of a second season are read in the first reference's zero: linked by
the calibration before, and through the fixed plate.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial

import numpy as np

from core.arrays import FloatArray
from core.calibration.calibrate import Calibration, calibrate
from core.calibration.views import CalibrationView, ViewRole
from core.images import GreyImage
from core.measurement import measure_pair
from core.moment import Moment
from core.results import Flag, Measurement
from core.rig.reference_places import errors_at_reference
from core.site import (
    MAIN,
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    ExtraTarget,
    QualityLimits,
    RigPrior,
    Site,
    StabilityBudget,
    TargetRole,
)
from daemon.datum.candidates import by_fixed_targets, by_old_calibration
from daemon.datum.chain import offset_by, origin
from daemon.datum.seen import Known, NewReference, SeenRow
from daemon.slots.measuring import ActiveCalibration
from daemon.store.records import DatumRecord
from daemon.store.rows.datum import in_record_zero
from drivers.sim.frameset_writer import head_reach_deg
from drivers.sim.settings import (
    Breathing,
    Climate,
    Motion,
    Scenario,
    SimPlate,
    SimSettings,
    Triple,
)
from drivers.sim.world import World

_LAST_MINUTES = (20160, 14400, 8640, 4320, 1440, 60)
"""Before the second reference, rows tell how the pair travels."""
DAYS, LENS_VIEWS, RIG_VIEWS = 145.0, 10, 13
"""As the season that docs/method.md shows."""
_CENTRES_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
_MINUTE = timedelta(minutes=1)
_PLATE_MM = (108.0, 30.0)
"""Of the fixed plate's middle beside the main target's, at 22 m."""
_NAMES = (
    *("with a fixed plate", "without"),
    *("second season, with a fixed plate, linked by the calibration before", "without, likewise"),
    "second season, linked through the fixed plate",
)


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


def bending(budget: StabilityBudget, rng: np.random.Generator) -> Breathing:
    """A rig whose every change is drawn from what the budget says, 1 sigma."""

    def three(sigma: float) -> Triple:
        x, y, z = sigma * rng.standard_normal(3)
        return float(x), float(y), float(z)

    def two(sigma: float) -> tuple[float, float]:
        return three(sigma)[:2]

    def creep(sigma: float) -> Triple:
        return sigma, sigma, sigma

    return Breathing(
        cameras_urad_per_k=three(budget.cameras_urad_per_k),
        cameras_urad_per_sqrt_day=creep(budget.cameras_urad_per_sqrt_day),
        main_px_per_k=two(budget.main_px_per_k),
        main_scale_ppm_per_k=three(1e6 * budget.main_scale_per_k)[0],
        sub_px_per_k=two(budget.sub_px_per_k),
        board_ppm_per_k=three(1e6 * budget.board_expansion_per_k)[0],
        board_urad_per_k=three(budget.board_urad_per_k),
        board_urad_per_sqrt_day=creep(budget.board_urad_per_sqrt_day),
        air_gradient_k_per_m=three(budget.air_gradient_k_per_m)[0],
    )


def make(seed: int) -> tuple[Site, SimSettings]:
    """A site at 22 m with a fixed plate; on large pixels lenses shift by half as many."""
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
        extra_targets=(extra,),
        stability=StabilityBudget(main_px_per_k=0.01, sub_px_per_k=0.0025),
    )
    settings = SimSettings(
        seed=seed,
        scenarios=(Scenario("drift"), Scenario("bridge")),
        motion=Motion(drift_mrad=0.3, drift_mm=1.0, bridge_daily_mm=5.0),
        climate=Climate(air_daily_k=6, air_seasonal_k=12, air_weather_k=3, camera_lag_h=1),
        breathing=bending(site.stability, np.random.default_rng([seed, 91])),
        plates=(SimPlate("abutment", offset_mm=_PLATE_MM),),
    )
    return site, settings


def run(rows: int, seed: int) -> tuple[Season, ...]:
    """Calibrate one site and measure its season, with the fixed plate and without; and again."""
    site, settings = make(seed)
    world, rng = World(site, settings), np.random.default_rng([seed, 92])
    bare = replace(site, extra_targets=())
    begin_utc = settings.start_utc
    reference_utc = begin_utc - 100 * _MINUTE
    first = _calibrated(world, site, reference_utc, rng)
    without = replace(first, calibrated=replace(first.calibrated, further=()))
    both = ((site, first), (bare, without))
    seen = _rows(world, rows, (begin_utc, reference_utc), both, rng)
    again_utc = begin_utc + timedelta(days=DAYS)
    second = _calibrated(world, site, again_utc, rng)
    alone = replace(second, calibrated=replace(second.calibrated, further=()))
    later = _rows(
        world,
        rows,
        (again_utc + 100 * _MINUTE, reference_utc),
        ((site, second), (bare, alone)),
        rng,
    )
    record = [
        _seen_row(world, again_utc - minutes * _MINUTE, site, first) for minutes in _LAST_MINUTES
    ]
    zeros = [
        _zero(world, (of, earlier, new), (reference_utc, again_utc), rows_before)
        for (of, earlier), new, rows_before in (
            (both[0], second, None),
            (both[1], alone, None),
            (both[0], second, record),
        )
    ]
    in_zero = [
        [(in_record_zero(found, link), truth_mm) for found, truth_mm in measured]
        for measured, link in zip((later[0], later[1], later[0]), zeros, strict=True)
    ]
    return tuple(_season(seed, one) for one in (*seen, *in_zero))


def _rows(
    world: World,
    rows: int,
    since: tuple[datetime, datetime],
    both: Sequence[tuple[Site, Calibration]],
    rng: np.random.Generator,
) -> list[list[Row]]:
    """Rows of a season from a time on, against the truth since another; by site and calibration."""
    seen: list[list[Row]] = [[] for _ in both]
    for row in range(rows):
        days = DAYS * (row + 0.3) / rows
        t_utc = since[0] + timedelta(days=days, hours=float(rng.uniform(0.0, 24.0)))
        truth_mm = world.truth(t_utc, since[1]).displacement_mm
        pair, moment = _pair(world, t_utc)
        for found, (of, by) in zip(seen, both, strict=True):
            found.append((measure_pair(*pair, of, by, moment=moment), truth_mm))
    return seen


def _pair(world: World, t_utc: datetime) -> tuple[tuple[GreyImage, GreyImage], Moment]:
    main, sub = (GreyImage(world.render(role, t_utc)) for role in ("main", "sub"))
    return (main, sub), Moment(t_utc.timestamp(), world.reported_c("main", t_utc))


def _seen_row(world: World, t_utc: datetime, site: Site, by: Calibration) -> SeenRow:
    pair, moment = _pair(world, t_utc)
    found = measure_pair(*pair, site, by, moment=moment)
    assert found.corrected is not None
    return SeenRow(t_utc, found.corrected, 1, motion=found.motion, closure=found.closure)


def _zero(
    world: World,
    calibrations: tuple[Site, Calibration, Calibration],
    times_utc: tuple[datetime, datetime],
    rows: Sequence[SeenRow] | None,
) -> DatumRecord:
    """The link of a second calibration: by the first, or through the fixed plate."""
    site, old, second = calibrations
    zero = origin(times_utc[0], times_utc[0], errors_at_reference(old.calibrated, site.sub))
    known = Known(ActiveCalibration(1, old, zero), times_utc[0])
    pair, moment = _pair(world, times_utc[1])
    errors = errors_at_reference(second.calibrated, site.sub)
    new = NewReference(times_utc[1], *pair, second, moment, None, errors=errors)
    if rows is None:
        found = by_old_calibration(known, new, site, board_untouched=True)[0]
    else:
        found = by_fixed_targets(known, new, site, rows)
    assert found is not None
    solved = offset_by(found.step, zero, errors)
    shared = {} if solved.shared is None else {MAIN: solved.shared}
    method, steps = found.step.method, (found.step,)
    return DatumRecord(method, solved.offset, steps, times_utc[1], errors=errors, shared=shared)


Row = tuple[Measurement, FloatArray]
"""And the truth (2,), mm."""


def _calibrated(
    world: World, site: Site, reference_utc: datetime, rng: np.random.Generator
) -> Calibration:
    views = []
    for k in range(LENS_VIEWS):
        world.hold_board(k)
        sub = GreyImage(world.render("sub", reference_utc - (100 + k) * _MINUTE))
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
    return replace(calibrate(views, site)[0], reference=warm)


def _season(seed: int, rows: list[Row]) -> Season:
    measured = [(found.corrected, truth_mm) for found, truth_mm in rows if found.corrected]
    return Season(
        seed,
        np.array([one.mm - truth_mm for one, truth_mm in measured]),
        np.array([one.covariance_mm2 for one, _ in measured]),
        np.array([one.shared_mm2 for one, _ in measured]),
        sum(found.flag is Flag.GOOD for found, _ in rows),
    )


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
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    seeds = range(asked.seed, asked.seed + asked.sites)
    both: list[list[Season]] = [[] for _ in _NAMES]
    with ProcessPoolExecutor(asked.jobs) as pool:
        for pair in pool.map(partial(run, asked.rows), seeds):
            for seasons, season, name in zip(both, pair, _NAMES, strict=True):
                seasons.append(season)
                said = f"{season.seed} {name}: {season.good} good;"
                print(said, line([season]), flush=True)
    for seasons, name in zip(both, _NAMES, strict=True):
        print("all", f"{name}:", line(seasons))


if __name__ == "__main__":
    main()
