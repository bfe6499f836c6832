"""OpenCV, mrgingham, mrcal and ViSP on the laboratory's frames, beside dcam."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from daemon.commands.output import progress
from studies.keep import Keep
from studies.laboratory import CODE as LABORATORY
from studies.laboratory_frames import LENS_VIEWS, POSITIONS, SEED, compute
from studies.page import Claim, Report, Table
from studies.peers_frames import CHAIN, DETECTORS, PACKAGES, has_programs
from studies.peers_frames import compute as compute_others

CODE = (*LABORATORY, "studies/peers_frames.py", "studies/peers_mrcal.py", "studies/peers_dots.cpp")
OTHERS = (f"{DETECTORS}, paper", f"{DETECTORS}, rigid", f"{CHAIN}, paper")


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
    asked = positions, lens_views, SEED, shrink
    with progress(2, "peers") as steps:
        errors = laboratory.block("frames", given, partial(compute, *asked))["errors"]
        steps.next("mrgingham, mrcal, ViSP")
        if has_programs():
            errors |= keep.block("others", given, partial(compute_others, *asked))["errors"]
        else:
            print(f"peers: mrgingham, mrcal and ViSP are left out: apt-get install {PACKAGES}")
    rms_mm, rows = {}, []
    for name in dict.fromkeys((*errors, *OTHERS)):
        detector, _, method = name.rpartition(", ")
        cells = ("not run", "not run", "")
        if name in errors:
            length = np.hypot(*np.array(errors[name]["mm"]).T)
            rms_mm[name] = float(np.sqrt(np.mean(length**2)))
            seconds = f"{errors[name]['locating_s']:.3f}"
            cells = f"{length.max():.4f}", f"{rms_mm[name]:.4f}", seconds
        rows.append((detector, method, *cells))
    columns = (
        "corners and discs; lens",
        "fit",
        "error, largest mm",
        "rms mm",
        "locating, CPU of a pair s",
    )
    best = min(rms_mm, key=lambda name: (name.startswith("dcam"), rms_mm[name]))
    ratio = rms_mm[best] / rms_mm["dcam, rigid"]
    claim = f"dcam errs {ratio:.0f} times less than the best of the others ({best})"
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    tables = {"peers": Table(columns, tuple(rows))}
    return Report("peers", "Peers", text, tables, [Claim(claim, ratio > 1.0)])
