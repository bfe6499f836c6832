"""The budget of rows against a Monte Carlo of the model: `python -m benchmarks.uncertainty`.

Sites without images, as `benchmarks.made_sites` makes them: two at 11 m, two at 22 m, and of each a
row of the day of the calibration and one that is a month and 10 K older.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.made_sites import Case, NumbersSite, make_numbers
from core.analysis.budget import Budget, RowState
from core.analysis.monte_carlo import monte_carlo
from core.analysis.row_budget import row_budget
from core.checkerboard.resection import resect
from core.moment import Moment
from core.rig.compensation import (
    SeenTarget,
    corrected_displacement,
    raw_displacement,
    rig_motion,
)
from core.rig.stability import main_scale, stability_terms

_MONTH = Moment(30 * 86_400.0, 10.0)
_DAY = Moment(3_600.0, 0.5)


def budget_of(made: NumbersSite, number: int, now: Moment) -> tuple[Budget, float]:
    """Budget of a row at a moment after the reference; sigma of its image part, y, mm."""
    calibrated, pair = made.calibrated, made.pairs[number][1]
    board = resect(calibrated.lens, calibrated.corners_mm, pair.board.view)
    corrected, _ = corrected_displacement(calibrated, pair.discs, board, pair.board.view)
    raw, _ = raw_displacement(calibrated, SeenTarget(calibrated.main_target, pair.discs))
    row = RowState(
        board.pose.compose(calibrated.reference_pose.inverse()),
        rig_motion(calibrated, board).covariance,
        {"main": raw.covariance_mm2},
        {"main": raw.mm},
        corners=len(pair.board.view.index),
        image_mm2=corrected.covariance_mm2,
    )
    scale = main_scale(calibrated.B)
    terms = stability_terms(made.site, scale, Moment(0.0, 0.0), now, calibrated.lens)
    return row_budget(made.site, calibrated, row, terms), float(
        np.sqrt(corrected.covariance_mm2[1, 1])
    )


def main() -> None:
    """Print a line for each row."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.uncertainty", description=__doc__)
    parser.add_argument("--trials", type=int, default=20_000)
    parser.add_argument("--all", action="store_true", help="all trials, though decided before")
    options = parser.parse_args()
    print("site  row    u y mm  trials  s/u x  s/u y  95 % x  95 % y  k y   U y mm  ms a trial")
    for kind in ("lab", "field"):
        for seed in (1, 2):
            made = make_numbers(Case(kind), seed)
            for name, now in (("day", _DAY), ("month", _MONTH)):
                budget, _ = budget_of(made, 5, now)
                begin = time.perf_counter()
                drawn = monte_carlo(
                    budget, options.trials, np.random.default_rng(seed), all_trials=options.all
                )
                took_ms = 1e3 * (time.perf_counter() - begin)
                assert drawn is not None
                expanded = budget.expanded(1)
                (x, y), (wide_x, wide_y) = drawn.ratio, drawn.interval_ratio
                print(
                    f"{kind:5} {name:6} {expanded.combined_mm:.4f}  {drawn.trials:6d}  {x:.3f}  "
                    f"{y:.3f}  {wide_x:.3f}   {wide_y:.3f}   {expanded.coverage_factor:.2f}  "
                    f"{expanded.expanded_mm:.4f}  {took_ms / drawn.trials:.1f}"
                )


if __name__ == "__main__":
    main()
