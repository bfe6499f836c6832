"""Run the benchmarks and write their table: `python -m benchmarks --output docs/benchmarks.md`."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

import cv2

from benchmarks.accuracy import FRAMES, SLOW_FRAMES, Accuracy, measure_accuracy
from benchmarks.finders import FinderCost, measure_finders, worst
from benchmarks.memory import SETTLED_AT, MemoryUse, measure_memory
from benchmarks.pair import CONFIG, PAIRS, PairCost, further_target_cost, measure_cost
from benchmarks.record import ROWS, RecordCost, measure_record
from benchmarks.status import SLOTS, StatusCost, measure_status
from daemon.config.reading import load_config

LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless")
SOAK = "## Soak"
"""Heading of the page's last section, written by hand from `python -m benchmarks.soak`."""
COLUMNS = ("ratio", "what", "dcam", "against")

Row = tuple[str, str, str, str]
"""One line of the table, as COLUMNS."""


def main() -> None:
    """Measure, print, and write the page if a file is named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--output", type=Path, metavar="FILE", help="Markdown page to write")
    parser.add_argument("--slots", type=int, default=1000, help="slots of the memory run")
    parser.add_argument("--rows", type=int, default=ROWS, help="rows of the long record")
    options = parser.parse_args()
    memory, status = measure_memory(options.slots), measure_status()
    record = measure_record(options.rows)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    pair, accuracies = measure_cost(), measure_accuracy(load_config(CONFIG).site())
    text = page(pair, accuracies, memory, status, record, measure_finders())
    print(text)
    if options.output:
        options.output.write_text(text + soak_section(options.output), encoding="utf-8")


def soak_section(path: Path) -> str:
    """Give what the page says of the soak, which takes too long to be run each time."""
    old = path.read_text(encoding="utf-8") if path.exists() else ""
    begin = old.find(SOAK)
    return "\n" + old[begin:] if begin >= 0 else ""


def page(
    pair: PairCost,
    accuracies: tuple[Accuracy, ...],
    memory: MemoryUse,
    status: StatusCost,
    record: RecordCost,
    finders: list[FinderCost],
) -> str:
    """Write the results as one Markdown page."""
    rows = [row for accuracy in accuracies for row in accuracy_rows(accuracy)]
    rows += [*time_rows(pair, accuracies[0]), memory_row(memory), status_row(status)]
    rows += [*record_rows(record), *finder_rows(finders)]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"""# Benchmarks

Written by `make bench`; your machine will differ. Processor: {cpu_model()}, one core used.
Python {platform.python_version()}, {libraries}.

The ratio is dcam's figure over the other one of the same run: below 1, dcam is better or faster.
A bound cannot be undercut but by the luck of {FRAMES} frames.

| {" | ".join(COLUMNS)} |
| --- | --- | --- | --- |
{table}

## How it was measured

**Frames** of {pair.width_px} x {pair.height_px} px, rendered for the site in `config.example.toml`,
11 m to the main target; the rig drifts by up to 1 mrad and 1.5 mm about and along each axis.
*Ideal*: flat and true print, even light and blur, no distortion; shot and read noise. *Realistic*:
print errors, bow, shading of 45 %, blur that grows by half towards the corners, distortion. All
methods get the same {FRAMES} frames (`findChessboardCornersSB`, which is slow, {SLOW_FRAMES} of
them), the true lens and the true board: this is about locating, not about calibration.

**Pose error.** The false displacement that a wrong pose makes at the main target: rms of its
length. *Relative to a reference*: the motion from one frame to the next against the true one. *Per
frame*: the frame's own pose against the true one.

**Bound of the pose** (Cramer-Rao, `benchmarks/bound.py`): Fisher information of all pixels of the
sub image, each with its own variance (shot and read noise, rounding). Unknown are the six of the
pose and, for the whole image, gain, offset and blur. The motion's bound is sqrt 2 of the frame's.
**Bound of the discs**: of the mean of their centres. A disc's size, light and blur are even about
its centre, so that not knowing them costs nothing.

**OpenCV** is helped: its corners start from a prediction about 1 px from the truth; those of
`findChessboardCornersSB` are named by the truth, and those cut by the image border left out.
Window 5 is 11 x 11 px, window 20 reaches half a square to each side. Its time and ours begin with
the prediction of the corners from a pose, which is the same function.

**Own sigma**: the 1 sigma that dcam's pose claims over the error it made, for one frame.

**Times** are CPU times of one core, medians; of a pair over {PAIRS} pairs with {pair.corners}
corners. Over these pairs the false displacement was {pair.rms_false_mm:.2f} mm rms, and the
displacement corrected with a calibration from rendered views was wrong by
{pair.rms_error_mm:.4f} mm rms.

**Memory**: `dcamd` on the small simulated rig of `benchmarks/small.toml`, {memory.slots} slots with
all they write, in {memory.seconds:.0f} s; resident memory then and after {SETTLED_AT} slots, when
every cache has been filled. Growth: {memory.growth_kb_per_slot:.2f} kB a slot.

**A long record**: whole commands on {record.rows} rows and their gaps, against a process in which
Python's `sqlite3` fetches all columns of the rows, and no more: a row's checksum is of all of them.
CPU time; the memory is the most that was resident. `python -m benchmarks.record` runs these alone.

**Finders** on images that show no target: noise, a grid of lines 4 px apart, ellipses as dense as
foliage, discs as dense as snow, black. The row is of the image that costs most. Its decoding is
that of the image itself or of noise of its size, whichever takes longer, as black is decoded in
no time. `python -m benchmarks.finders` gives all.
"""


def accuracy_rows(result: Accuracy) -> Iterator[Row]:
    """Rows on one kind of frames."""
    pose, ours, root2 = f"pose, {result.name} images", result.ours, 2.0**0.5
    bound = result.pose_bound_mm
    yield row(f"{pose}, relative to a reference: bound", ours.relative_mm, root2 * bound, mm)
    yield row(f"{pose}, per frame: bound", ours.frame_mm, bound, mm)
    for name, other in result.others.items():
        yield row(f"{pose}, relative: {name}", ours.relative_mm, other.relative_mm, mm)
    for name, other in result.others.items():
        yield row(f"{pose}, per frame: {name}", ours.frame_mm, other.frame_mm, mm)
    yield row(f"{pose}, own sigma: error made", result.claimed_mm, ours.frame_mm, mm)
    discs = f"discs, {result.name} images"
    mine, ellipses = result.discs.relative_mm, result.other_discs.relative_mm
    yield row(f"{discs}, relative: bound", mine, root2 * result.disc_bound_mm, um)
    yield row(f"{discs}, relative: threshold and `fitEllipse`", mine, ellipses, um)


def time_rows(pair: PairCost, result: Accuracy) -> Iterator[Row]:
    """Rows on time."""
    size = f"{pair.width_px} x {pair.height_px} px"
    what = f"time of a pair of {size}, images to displacement: decoding both PNGs"
    yield row(what, pair.measure_s, pair.decode_s, ms)
    what = f"time of a pair of {size} with one further target in the main image: without it"
    yield row(what, *further_target_cost(), ms)
    for half, seconds in result.subpix_s.items():
        what = (
            f"time of corner fit and pose: `cornerSubPix`, window {half}, `solvePnP`, same corners"
        )
        yield row(what, result.fit_s, seconds, ms)


def status_row(status: StatusCost) -> Row:
    """A monitoring system's question against a process that does nothing."""
    ratio = status.status_s / status.nothing_s
    what = f"time of `dcam-ctl status`, {SLOTS} slots: `python -c pass`"
    return (
        f"{ratio:.1f}",
        what,
        f"{1e3 * status.status_s:.0f} ms",
        f"{1e3 * status.nothing_s:.0f} ms",
    )


def record_rows(record: RecordCost) -> Iterator[Row]:
    """Rows on a record of years."""
    for name, cost in record.commands.items():
        what = f"time of `{name}`, {record.rows} rows, {cost.peak_mb:.0f} MB: fetching them"
        yield row(what, cost.cpu_s, record.fetch.cpu_s, lambda x: f"{x:.1f} s")


def finder_rows(costs: list[FinderCost]) -> Iterator[Row]:
    """Rows on looking for targets where there are none."""
    for cost in worst(costs):
        what = f"time of `{cost.finder}` without a target, {cost.size}, {cost.image}: decoding"
        yield row(what, cost.find_s, cost.decode_s, ms)


def memory_row(memory: MemoryUse) -> Row:
    """The row on memory."""
    what = f"memory of `dcamd` after {memory.slots} slots: after {SETTLED_AT}"
    return row(what, memory.end_mb, memory.settled_mb, lambda x: f"{x:.0f} MB")


def row(what: str, ours: float, other: float, text: Callable[[float], str]) -> Row:
    """One row, its ratio first."""
    return f"{ours / other:.2f}", what, text(ours), text(other)


def ms(seconds: float) -> str:
    """Milliseconds, for the table."""
    return f"{1000.0 * seconds:.1f} ms"


def mm(value: float) -> str:
    """Millimetres, for the table."""
    return f"{value:.4f} mm"


def um(value_mm: float) -> str:
    """Micrometres, for the table."""
    return f"{1000.0 * value_mm:.3f} um"


def cpu_model() -> str:
    """Give the processor's name as the kernel tells it."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


if __name__ == "__main__":
    main()
