"""The paper's laboratory test: 11 m, false displacement to 44 mm; dcam's and OpenCV's detectors."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from core.arrays import FloatArray
from daemon.commands.output import progress
from studies.figure import COLOURS, new_figure
from studies.keep import Keep
from studies.laboratory_frames import LENS_VIEWS, POSITIONS, SEED, compute
from studies.page import Claim, Report, Table

CODE = ("studies/laboratory_frames.py",)
LIMIT_MM = 0.02
"""What our corners and our model must stay below."""


def run(
    keep: Keep,
    *,
    positions: int = POSITIONS,
    lens_views: int = LENS_VIEWS,
    shrink: float = 1.0,
    limit_mm: float = LIMIT_MM,
) -> Report:
    """Compute and judge."""
    with progress(1, "laboratory") as steps:
        given = {"positions": positions, "lens_views": lens_views, "seed": SEED, "shrink": shrink}
        found = keep.block("frames", given, partial(compute, positions, lens_views, SEED, shrink))
        steps.next("done")
    return report(found, limit_mm)


def report(found: dict[str, Any], limit_mm: float) -> Report:
    """Write the page."""
    raw_mm = float(_length(found["raw"]).max())
    rows = [("the paper's own figure", "44.1", "1.1", "")]
    for name, result in found["errors"].items():
        length = _length(result["mm"])
        most, rms = float(length.max()), float(np.sqrt(np.mean(length**2)))
        rows.append((name, f"{raw_mm:.1f}", f"{most:.4f}", f"{rms:.4f}"))
    ours_mm = float(_length(found["errors"]["dcam, rigid"]["mm"]).max())
    claim = f"dcam's corners and `rigid` are within {limit_mm} mm: at most {ours_mm:.4f} mm"
    columns = ("corners and discs, method", "false, largest mm", "error, largest mm", "rms mm")
    return Report(
        "laboratory",
        "Laboratory",
        Path(__file__).with_suffix(".md").read_text(encoding="utf-8"),
        {"errors": Table(columns, tuple(rows))},
        [Claim(claim, ours_mm <= limit_mm)],
        {"laboratory.png": partial(draw, found)},
    )


def _length(mm: list[list[float]]) -> FloatArray:
    return np.asarray(np.hypot(*np.array(mm).T))


def draw(found: dict[str, Any], output: Path) -> None:
    """Draw raw displacement and errors over the positions."""
    figure, (raw, error) = new_figure(10.0, 6.0, rows=2, sharex=True)
    numbers = np.arange(1, len(found["raw"]) + 1)
    for axis, (name, style) in enumerate((("x", "o-"), ("y", "s--"))):
        raw.plot(numbers, np.array(found["raw"])[:, axis], style, color=COLOURS[2], label=name)
    styles = zip(found["errors"].items(), ("-", "-", "--", "--"), (1, 1, 0, 0), strict=True)
    for (name, result), style, colour in styles:
        marker = "o" if "rigid" in name else "s"
        error.semilogy(
            *(numbers, _length(result["mm"]), style + marker),
            color=COLOURS[colour],
            alpha=1.0 if "rigid" in name else 0.5,
            label=name,
        )
    error.axhline(1.1, color="black", linewidth=0.8, linestyle=":", label="the paper: 1.1 mm")
    raw.set_ylabel("main camera alone (mm)")
    error.set_ylabel("error after correction (mm)")
    error.set_xlabel("position of the head")
    for panel in (raw, error):
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=8, frameon=False)
    figure.savefig(output, dpi=110)
