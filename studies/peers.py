"""OpenCV's detectors and the paper's fit on the laboratory's frames, beside dcam's."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from daemon.commands.output import progress
from studies.keep import Keep
from studies.laboratory import CODE as LABORATORY
from studies.laboratory_frames import LENS_VIEWS, POSITIONS, SEED, compute
from studies.page import Claim, Report, Table

CODE = LABORATORY


def run(
    keep: Keep,
    *,
    positions: int = POSITIONS,
    lens_views: int = LENS_VIEWS,
    shrink: float = 1.0,
) -> Report:
    """Take the laboratory's frames, or render them, and compare."""
    given = {"positions": positions, "lens_views": lens_views, "seed": SEED, "shrink": shrink}
    laboratory = Keep(keep.directory.parent / "laboratory", LABORATORY)
    with progress(1, "peers"):
        make = partial(compute, positions, lens_views, SEED, shrink)
        errors = laboratory.block("frames", given, make)["errors"]
    rms_mm, rows = {}, []
    for name, result in errors.items():
        length = np.hypot(*np.array(result["mm"]).T)
        rms_mm[name] = float(np.sqrt(np.mean(length**2)))
        detector, method = name.split(", ")
        cells = f"{length.max():.4f}", f"{rms_mm[name]:.4f}", f"{result['locating_s']:.3f}"
        rows.append((detector, method, *cells))
    columns = (
        "corners and discs",
        "fit",
        "error, largest mm",
        "rms mm",
        "locating, CPU of a pair s",
    )
    ratio = rms_mm["OpenCV, paper"] / rms_mm["dcam, rigid"]
    claim = f"dcam errs {ratio:.0f} times less than OpenCV's detectors with the paper's fit"
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    tables = {"peers": Table(columns, tuple(rows))}
    return Report("peers", "Peers", text, tables, [Claim(claim, ratio > 1.0)])
