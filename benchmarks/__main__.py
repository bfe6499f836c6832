"""Run the benchmarks and write their table: `python -m benchmarks --output docs/benchmarks.md`."""

from __future__ import annotations

import argparse
import platform
from importlib.metadata import version
from pathlib import Path

from benchmarks.memory import SETTLED_AT, MemoryUse, measure_memory
from benchmarks.pair import PAIRS, PairCost, measure_cost

LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless")


def main() -> None:
    """Measure, print, and write the page if told where."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--output", type=Path, metavar="FILE", help="Markdown page to write")
    parser.add_argument("--slots", type=int, default=1000, help="slots of the memory run")
    options = parser.parse_args()
    memory = measure_memory(options.slots)
    text = page(measure_cost(), memory)
    print(text)
    if options.output:
        options.output.write_text(text, encoding="utf-8")


def page(pair: PairCost, memory: MemoryUse) -> str:
    """Write the results as one Markdown page."""
    size = f"{pair.width_px} x {pair.height_px} px"
    rows = [
        (f"One pair, two images of {size}, to a displacement", ms(pair.measure_s), "1"),
        ("Decoding the two PNGs alone", ms(pair.decode_s), ratio(pair.decode_s, pair)),
        (
            "`cornerSubPix` and `solvePnP` alone, corners known to 1 px",
            ms(pair.opencv_s),
            ratio(pair.opencv_s, pair),
        ),
    ]
    table = "\n".join(f"| {what} | {cost} | {share} |" for what, cost, share in rows)
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"""# Benchmarks

Written by `make bench`; your machine will differ. Processor: {cpu_model()}, one core used.
Python {platform.python_version()}, {libraries}.

## One frame pair

Median of {PAIRS} rendered pairs of the site in `config.example.toml` (drift of 1 mrad and 1.5 mm),
CPU time of one core. {pair.corners} corners were fitted.

| what | CPU time | of a pair |
| --- | --- | --- |
{table}

A pair takes {pair.measure_s / pair.decode_s:.1f} times as long as decoding its images. OpenCV's
figure is no full measurement: corners are given to it, not found, and no disc is looked for.

Over these pairs the false displacement was {pair.rms_false_mm:.2f} mm rms, and the corrected
displacement was wrong by {pair.rms_error_mm:.3f} mm rms.

## Memory

`dcamd` on the small simulated rig of `benchmarks/small.toml`, {memory.slots} slots with all they
write, in {memory.seconds:.0f} s.

| after slot | resident memory |
| --- | --- |
| {SETTLED_AT} | {memory.settled_mb:.1f} MB |
| {memory.slots} | {memory.end_mb:.1f} MB |

Growth: {memory.growth_kb_per_slot:.2f} kB a slot.
"""


def ms(seconds: float) -> str:
    """Milliseconds, for the table."""
    return f"{1000.0 * seconds:.0f} ms"


def ratio(seconds: float, pair: PairCost) -> str:
    """Share of a pair's cost."""
    return f"{seconds / pair.measure_s:.2f}"


def cpu_model() -> str:
    """Give the processor's name as the kernel tells it."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


if __name__ == "__main__":
    main()
