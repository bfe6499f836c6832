"""False alarms and power of `board_slipped` on simulated years: `python -m benchmarks.slip`.

Nothing is rendered: what rig, bridge and noise do is drawn as numbers, row by row, and the detector
is the daemon's own. Each bridge has a seed; `--rows` gives other lengths than a year. Prints
the tables of docs/method.md, and with `--figure FILE` draws the power.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import maximum_filter1d

from benchmarks.slip_bridges import BRIDGES, DAY, Simulate
from core.arrays import FloatArray, IntArray
from core.quality.junction import CHANNELS, NOISE_SIGMAS
from core.quality.opposed_steps import (
    BLOCK_ROWS,
    MATCH,
    ROWS_A_FALSE_ALARM,
    TESTS,
    block_medians,
)
from core.quality.row_series import Quantity, RowSeries, RowSummary
from core.quality.step_detection import USUAL_ROWS, StepDetector, unlikeliest_jump
from core.results import Reason
from core.site import QualityLimits

SIZES_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Slips whose detection is tried."""
TRIALS = 100
"""Slips of each size on each bridge."""
SHORT_SETS = (3, 4, 5, 6, 8, 12, 20)
"""Rows of sets that are as short as frame sets are."""
CHANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1.0 / ROWS_A_FALSE_ALARM)
"""Thresholds of a row's chance at which rows are counted: more often than a false alarm a year."""


def candidates(rows: RowSeries) -> IntArray:
    """Rows whose chance can be below the largest of CHANCES: most are clearly not among them.

    Such a row's step, or its block's, is opposed in some channel and axis and no noise, and its
    opposed part has at most two larger ones among the steps before, or none among blocks.
    """
    cut = np.diff(rows.time_s) > 1.5 * np.median(np.diff(rows.time_s))
    found = np.concatenate([[False], cut])
    for count in (1, BLOCK_ROWS):
        whole = np.lib.stride_tricks.sliding_window_view(~cut, 2 * count - 1).min(axis=1)
        names: tuple[Quantity, ...] = (*CHANNELS, "mm")
        middles = [block_medians(rows.values_mm(name), count) for name in names]
        *steps, moved = (values[count:] - values[:-count] for values in middles)
        noise_mm = NOISE_SIGMAS / count**0.5 * rows.sigma_mm("mm")[2 * count - 1 :, None]
        for step in steps:
            size_mm = np.minimum(np.abs(step), np.abs(moved)) * (step * moved < 0.0)
            cancel = np.abs(step + moved) < MATCH * size_mm
            usual_mm = _exceeded_before(size_mm * whole[:, None], count)
            large = (size_mm > noise_mm) & (size_mm > usual_mm)
            found[2 * count - 1 :] |= (cancel & large).any(axis=1)
    return np.flatnonzero(found)


def _exceeded_before(sizes: FloatArray, count: int) -> FloatArray:
    """What at least three of the steps before each one (n, 2) reach, or one of the blocks."""
    chunk = (USUAL_ROWS - 2 * count) // (3 if count == 1 else 1) // 2 * 2 - 1
    largest = maximum_filter1d(sizes, chunk, axis=0, mode="constant", cval=0.0, origin=chunk // 2)
    lags = [count + k * chunk for k in range(3 if count == 1 else 1)]
    return np.asarray(np.min([_later(largest, lag) for lag in lags], axis=0))


def _later(values: FloatArray, lag: int) -> FloatArray:
    shifted = np.zeros_like(values)
    shifted[lag:] = values[:-lag]
    return shifted


def row_chances(rows: RowSeries) -> FloatArray:
    """Bound of each row's chance (n,) to look like a slip, all tests of it together."""
    chances = np.ones(len(rows))
    for k in candidates(rows):
        jump = unlikeliest_jump(rows[max(k - USUAL_ROWS, 0) : k], rows[k : k + 1])
        if jump is not None:
            chances[k] = min(1.0, TESTS * jump.chance)
    return chances


def false_alarms(simulate: Simulate, n: int, seed: int) -> FloatArray:
    """How many of n rows have chances below CHANCES, all of them clean."""
    chances = row_chances(simulate(np.random.default_rng(seed), n).rows())
    return np.array([(chances <= limit).sum() for limit in CHANCES])


def short_set_chances(rows: int, sets: int, seed: int) -> FloatArray:
    """Bound of the chance of the row (sets,) after so many, hours apart, in sets of their own.

    Rig and bridge walk at random, with steps of Student's t of 3 and of one size.
    """
    rng = np.random.default_rng(seed)
    rig, bridge = np.cumsum(rng.standard_t(3, (2, sets, rows + 1)), axis=2)
    moved = np.abs(np.diff(bridge, axis=1))
    turned = np.diff(rig, axis=1)[:, -1]
    size = np.minimum(np.abs(turned), moved[:, -1])
    cancel = np.abs(turned + np.diff(bridge, axis=1)[:, -1]) < MATCH * size
    chances, still = np.ones(sets), np.zeros(rows + 1)
    times_s, sigma_mm = 3600.0 * np.arange(rows + 1.0), np.full(rows + 1, 1e-3)
    for k in np.flatnonzero(cancel & (size > moved[:, :-1].max(axis=1))):
        values: dict[Quantity, FloatArray] = {
            "mm": np.column_stack([still, bridge[k]]),
            "false_mm": np.column_stack([still, rig[k]]),
            "slide_mm": np.zeros((rows + 1, 2)),
        }
        series = RowSeries.of_columns(times_s, values, dict.fromkeys(values, sigma_mm), still)
        jump = unlikeliest_jump(series[:-1], series[-1:])
        if jump is not None:
            chances[k] = min(1.0, TESTS * jump.chance)
    return chances


def power(
    simulate: Simulate, size_mm: float, history: int, seed: int, trials: int = TRIALS
) -> tuple[float, float]:
    """Shares of slips marked in their first row, and by the last row of the block after it."""
    rng, at_once, later = np.random.default_rng(seed), 0, 0
    for _ in range(trials):
        motion = simulate(rng, history + DAY + BLOCK_ROWS)
        start = int(rng.integers(history, history + DAY))
        slip_mm = np.zeros((len(motion.time_s), 2))
        slip_mm[start:, rng.integers(2)] = rng.choice([-1.0, 1.0]) * size_mm
        rows = motion.rows(slip_mm)
        state = StepDetector(rows[start - history : start])
        marked = []
        for k in range(start, start + BLOCK_ROWS):
            reasons, state = state.judge(_summary(rows, k), QualityLimits())
            marked.append(Reason.BOARD_SLIPPED in reasons)
        at_once, later = at_once + marked[0], later + any(marked)
    return at_once / trials, later / trials


def _summary(rows: RowSeries, k: int) -> RowSummary:
    names: tuple[Quantity, ...] = ("mm", "false_mm", "slide_mm")
    mm, false_mm, slide_mm = (rows.values_mm(name)[k] for name in names)
    sigma_mm = np.array([rows.sigma_mm(name)[k] for name in names])
    return RowSummary(float(rows.time_s[k]), mm, false_mm, slide_mm, sigma_mm, 1.0, trusted=True)


def alarm_table(n: int) -> Iterator[str]:
    """Lines of the table of false alarms."""
    yield "| bridge | " + " | ".join(f"{limit:.0e}" for limit in CHANCES) + " |"
    yield "| --- |" + " --- |" * len(CHANCES)
    yield "| allowed | " + " | ".join(f"{limit * n:.0f}" for limit in CHANCES) + " |"
    for seed, simulate in enumerate(BRIDGES):
        counts = false_alarms(simulate, n, seed)
        yield f"| {simulate.__name__} | " + " | ".join(str(count) for count in counts) + " |"


def short_table(sets: int) -> Iterator[str]:
    """Lines of the table of false alarms after few rows."""
    for rows in SHORT_SETS:
        chances = short_set_chances(rows, sets, rows)
        counts = [str((chances <= limit).sum()) for limit in CHANCES]
        yield f"| after {rows} rows | " + " | ".join(counts) + " |"


def power_table(found: dict[str, list[tuple[float, float]]]) -> Iterator[str]:
    """Lines of the table of power."""
    yield "| bridge | " + " | ".join(f"{size:g} mm" for size in SIZES_MM) + " |"
    yield "| --- |" + " --- |" * len(SIZES_MM)
    for name, shares in found.items():
        cells = (f"{100 * once:.0f}, {100 * later:.0f} %" for once, later in shares)
        yield f"| {name} | " + " | ".join(cells) + " |"


def measure_power(history: int) -> dict[str, list[tuple[float, float]]]:
    """Power on each bridge after so many rows."""
    return {
        simulate.__name__: [
            power(simulate, size, history, 100 * seed + k) for k, size in enumerate(SIZES_MM)
        ]
        for seed, simulate in enumerate(BRIDGES)
    }


def draw_power(found: dict[str, list[tuple[float, float]]], file: Path) -> None:
    """Draw the curves: slips marked at once, and within a block."""
    figure = Figure(figsize=(9.5, 3.4), layout="constrained")
    titles = "marked in its first row", f"marked within {BLOCK_ROWS} rows"
    every = figure.subplots(1, 2, sharey=True)
    for column, (axes, title) in enumerate(zip(every, titles, strict=True)):
        for name, shares in found.items():
            percent = [100.0 * pair[column] for pair in shares]
            axes.semilogx(SIZES_MM, percent, ".-", label=name.replace("_", " "))
        axes.set(xlabel="slip, mm", title=title, xticks=SIZES_MM)
        axes.set_xticklabels([f"{size:g}" for size in SIZES_MM])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    every[0].set_ylabel("% of slips")
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(file, dpi=110)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.slip", description=__doc__)
    parser.add_argument("--rows", type=int, default=ROWS_A_FALSE_ALARM, help="of each bridge")
    parser.add_argument("--figure", type=Path, metavar="FILE")
    options = parser.parse_args()
    for line in alarm_table(options.rows):
        print(line, flush=True)
    for line in short_table(options.rows):
        print(line, flush=True)
    found = measure_power(USUAL_ROWS)
    print(*power_table(found), sep="\n")
    if options.figure:
        draw_power(found, options.figure)


if __name__ == "__main__":
    main()
