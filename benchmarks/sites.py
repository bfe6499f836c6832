"""How true the errors and their sigma are over many simulated sites: `python -m benchmarks.sites`.

The rows of one site share the error of its calibration, so one site says little about sigma;
many do. Without images ("numbers") the true corners and discs get noise of a known covariance,
so that a site takes seconds; with `--render` every image is rendered and looked at.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.made_sites import Case, NumbersSite, Shot, make_numbers, make_site, shots
from core.arrays import FloatArray
from core.calibration.calibrate import CalibrationView, calibrate
from core.calibration.views import PairView
from core.checkerboard.resection import resect
from core.images import GreyImage
from core.measurement import measure_pair
from core.results import Flag
from core.rig.compensation import corrected_displacement
from drivers.sim.head import SimulatedHead
from drivers.sim.world import World


@dataclass(frozen=True, slots=True)
class Row:
    """One measured pair, the truth taken off."""

    error_mm: FloatArray
    """(2,)."""
    covariance_mm2: FloatArray
    """(2, 2)."""
    good: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """One site: its rows, and what its calibration expected of itself."""

    seed: int
    rows: tuple[Row, ...]
    lost: int
    """Rows without a value."""
    passed: bool


def run_numbers(case: Case, seed: int) -> Outcome:
    """One site without images."""
    made = make_numbers(case, seed)
    rows = measured(made, made.pairs, quiet=case.quiet_rows)
    return Outcome(seed, rows, 0, passed=True)


def measured(
    made: NumbersSite, pairs: Sequence[tuple[Shot, PairView]], *, quiet: bool
) -> tuple[Row, ...]:
    """Measure pairs by the site's calibration; of quiet ones the sigma is the calibration's."""
    calibrated, rows = made.calibrated, []
    for shot, pair in pairs:
        board = resect(calibrated.lens, calibrated.corners_mm, pair.board.view)
        found, _ = corrected_displacement(calibrated, pair.discs, board, pair.board.view)
        made.head.move_to(*shot.head_deg)
        truth = made.world.truth(shot.utc)
        covariance = found.shared_mm2 if quiet else found.covariance_mm2
        assert covariance is not None
        rows.append(Row(found.mm - truth.displacement_mm, covariance, good=True))
    return tuple(rows)


def run_rendered(case: Case, seed: int) -> Outcome:
    """One site, every image rendered."""
    site, settings = make_site(case, seed)
    world = World(site, settings)
    head = SimulatedHead(world)
    views, rows, lost = [], [], 0
    calibration = None
    passed = False
    for number, shot in enumerate(shots(case, site, seed)):
        world.hold_board(shot.held)
        head.move_to(*shot.head_deg)
        sub = GreyImage(world.render("sub", shot.utc))
        main = None if shot.held is not None else GreyImage(world.render("main", shot.utc))
        if shot.role is not None:
            views.append(CalibrationView(str(number), shot.role, main, sub))
            continue
        if calibration is None:
            calibration, report = calibrate(views, site)
            passed = report.passed
            views.clear()
        found = measure_pair(main, sub, site, calibration)
        if found.corrected is None:
            lost += 1
            continue
        error_mm = found.corrected.mm - world.truth(shot.utc).displacement_mm
        rows.append(Row(error_mm, found.corrected.covariance_mm2, good=found.flag is Flag.GOOD))
    return Outcome(seed, tuple(rows), lost, passed)


@dataclass(frozen=True, slots=True)
class Figures:
    """Errors against their sigma, of one site or of many."""

    rms_mm: float
    max_mm: float
    z_rms: float
    within_1: float
    """Share of x and y within their 1 sigma; 0.68 is right."""
    within_2: float
    """0.95 is right."""
    within_1_apart: tuple[float, float]
    """Of x and of y."""
    whitened_rms: float
    """rms of the components along the covariance's own axes."""
    good: float
    """Share of the rows flagged good."""


def figures(rows: Sequence[Row], lost: int = 0) -> Figures:
    """Judge rows."""
    errors = np.array([row.error_mm for row in rows])
    covariances = np.array([row.covariance_mm2 for row in rows])
    z = errors / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    white = np.linalg.solve(np.linalg.cholesky(covariances), errors[:, :, None])
    inside = np.abs(z) < 1.0
    return Figures(
        float(np.sqrt((errors**2).sum(axis=1).mean())),
        float(np.hypot(errors[:, 0], errors[:, 1]).max()),
        float(np.sqrt((z**2).mean())),
        float(inside.mean()),
        float((np.abs(z) < 2.0).mean()),
        (float(inside[:, 0].mean()), float(inside[:, 1].mean())),
        float(np.sqrt((white**2).mean())),
        sum(row.good for row in rows) / (len(rows) + lost),
    )


def line(name: str, f: Figures) -> str:
    """One line of the table."""
    x, y = f.within_1_apart
    return (
        f"{name:>12} {f.rms_mm:8.4f} {f.max_mm:8.4f} {f.z_rms:6.2f} {f.whitened_rms:6.2f} "
        f"{f.within_1:6.2f} ({x:4.2f} {y:4.2f}) {f.within_2:6.2f} {f.good:6.2f}"
    )


HEADER = (
    f"{'site':>12} {'rms mm':>8} {'max mm':>8} {'z rms':>6} {'axes':>6} "
    f"{'in 1 s (x y)':>18} {'in 2 s':>6} {'good':>6}"
)


def main() -> None:
    """Run sites and print a line for each and for all."""
    options = parser().parse_args()
    case = Case(
        options.kind,
        options.print_um,
        options.bow_um,
        options.corner_um,
        None if options.distance_m is None else options.distance_m * 1000.0,
        options.shrink,
        options.quiet_rows,
    )
    run = partial(run_rendered if options.render else run_numbers, case)
    seeds = range(options.seed, options.seed + options.sites)
    print(HEADER, flush=True)
    rows: list[Row] = []
    lost, failed = 0, 0
    with ProcessPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(run, seeds):
            rows += outcome.rows
            lost, failed = lost + outcome.lost, failed + (not outcome.passed)
            if outcome.rows and not options.quiet:
                print(line(str(outcome.seed), figures(outcome.rows, outcome.lost)), flush=True)
    print(line("all", figures(rows, lost)))
    if failed:
        print(f"{failed} calibrations did not pass")


def parser() -> argparse.ArgumentParser:
    """Options."""
    made = argparse.ArgumentParser(prog="python -m benchmarks.sites", description=__doc__)
    made.add_argument("kind", choices=["lab", "field"])
    made.add_argument("--sites", type=int, default=20)
    made.add_argument("--seed", type=int, default=1, help="of the first site")
    made.add_argument("--print-um", type=float, default=4.0, help="rms error of a printed line")
    made.add_argument("--corner-um", type=float, default=0.0, help="rms error of a single corner")
    made.add_argument("--bow-um", type=float, default=25.0)
    made.add_argument("--distance-m", type=float)
    made.add_argument("--shrink", type=float, default=1.0, help="fewer pixels")
    made.add_argument("--quiet-rows", action="store_true", help="the calibration's errors alone")
    made.add_argument("--render", action="store_true", help="render and look at every image")
    made.add_argument("--jobs", type=int, default=1, help="processes")
    made.add_argument("--quiet", action="store_true", help="the pooled line only")
    return made


if __name__ == "__main__":
    main()
