"""What sigma depends on: the prediction of `dcam-ctl plan`, one thing changed at a time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from core.adjustment.bundle_adjustment import PrintSpread
from core.arrays import FloatArray
from core.calibration.joint_fit import FitOptions, Method, build_uncompressed_site, predict_fit
from core.geometry.pose import Pose
from core.moment import Moment
from core.planning.planned_site import CalibrationPlan, ImageQuality, PlannedSite
from core.planning.predicted_accuracy import (
    FAIR_PRINT,
    FrameNoise,
    drift_rows,
    predict_accuracy,
    predict_row,
)
from core.rig.calibrated_site import CalibratedSite
from core.rig.stability import stability_terms, total_covariance
from core.site import CheckerboardTarget, Site
from daemon.commands.output import progress
from studies.keep import Keep
from studies.laboratory_frames import (
    DISTANCE_MM,
    LENS_VIEWS,
    POSITIONS,
    SEED,
    TALLEST_MM,
    WIDEST_MM,
    compute,
    head_positions_deg,
    site_of,
)
from studies.page import Claim, Report, Table

CODE = ("studies/sensitivity.py", "studies/laboratory_frames.py")
DAYS = 30.0
"""After the calibration, in the table of temperatures."""
CHECK_FACTOR = 2.0
"""By which errors of rendered frames may differ from the prediction: one rig, one board."""


@dataclass(frozen=True, slots=True)
class TiltedSite(PlannedSite):
    """A site whose board leans."""

    tilt_deg: float = 0.0

    @property
    def T_CS1_WS(self) -> Pose:
        """The board before the sub-camera, turned about the middle of its own x axis."""
        square = PlannedSite(self.site, self.quality).T_CS1_WS
        turn = Pose.from_vectors(np.array([math.radians(self.tilt_deg), 0.0, 0.0]), np.zeros(3))
        target = self.site.sub_target
        half_mm = np.array([target.squares_x, target.squares_y, 0.0]) * target.square_mm / 2.0
        return Pose(turn.R, square.apply(half_mm[None])[0] - turn.R @ half_mm)


@dataclass(frozen=True, slots=True)
class Case:
    """One cell of the table."""

    what: str
    value: str
    site: Site
    quality: ImageQuality = field(default_factory=ImageQuality)
    tilt_deg: float = 0.0
    burst: int = 1
    spread: PrintSpread = FAIR_PRINT

    @property
    def planned(self) -> PlannedSite:
        """The site as planned."""
        return TiltedSite(self.site, self.quality, self.tilt_deg)


def at_distance(site: Site, metres: float) -> Site:
    """The site with its main target so far away, and as much larger."""
    target, factor = site.main_target, 1000.0 * metres / site.main_target.distance_mm
    moved = replace(
        target,
        centres_mm=target.centres_mm * factor,
        diameters_mm=target.diameters_mm * factor,
        distance_mm=1000.0 * metres,
    )
    return replace(site, main_target=moved)


def cases() -> Iterator[Case]:
    """The laboratory's hardware, one thing changed at a time."""
    base = site_of()
    for metres in (5.5, 11.0, 22.0, 44.0):
        yield Case("distance", f"{metres:g} m", at_distance(base, metres))
    for focal_mm in (4.0, 6.0, 8.0, 12.0):
        lens = replace(base.sub, focal_length_mm=focal_mm)
        yield Case("lens of the sub-camera", f"{focal_mm:g} mm", replace(base, sub=lens))
    for squares, square_mm in ((8, 8.0), (16, 4.0), (32, 2.0), (64, 1.0), (22, 2.0)):
        board = CheckerboardTarget(squares, squares - 1, square_mm, 50.0)
        size = f"{squares} x {squares - 1} squares of {square_mm:g} mm"
        yield Case("board", size, replace(base, sub_target=board))
    for tilt_deg in (0.0, 10.0, 20.0, 30.0):
        yield Case("tilt of the board", f"{tilt_deg:g} deg", base, tilt_deg=tilt_deg)
    for noise_dn in (0.5, 1.0, 2.0, 4.0):
        yield Case("noise", f"{noise_dn:g} DN", base, ImageQuality(noise_dn=noise_dn))
    for burst in (1, 4, 16):
        yield Case("burst", f"{burst} pairs", base, burst=burst)
    for line_um in (1.0, 5.0, 20.0):
        spread = PrintSpread(line_um * 1e-3, line_um * 1e-3, 0.2e-3 * line_um)
        yield Case("print error of a line", f"{line_um:g} um", base, spread=spread)


def calibration_plan() -> CalibrationPlan:
    """The laboratory's: 12 lens views, 21 positions spread over the reach."""
    # The same at every distance: the lens and the image are the same.
    reach_deg = np.degrees(np.array([WIDEST_MM, TALLEST_MM]) / DISTANCE_MM)
    tilts, pans = np.linspace(-1.0, 1.0, 3), np.linspace(-1.0, 1.0, 7)
    positions = [(float(p * reach_deg[0]), float(t * reach_deg[1])) for t in tilts for p in pans]
    return CalibrationPlan(LENS_VIEWS, tuple(positions))


def calibrated(case: Case) -> CalibratedSite:
    """What a calibration of this case will know."""
    planned = case.planned
    options = FitOptions(case.site, planned.board, Method.RIGID, skew=False)
    plan = calibration_plan()
    given = planned.views(plan), planned.lens, planned.poses(plan), options, case.spread
    return build_uncompressed_site(predict_fit(*given), options)


def predict(case: Case) -> list[float]:
    """Sigma at rest and within the expected drift, mm."""
    made = calibrated(case)
    share = 1.0 / case.burst
    rows = drift_rows(case.planned, made)
    found = predict_accuracy(rows, made.posterior, FrameNoise(share, share))
    return [float(found.still_mm.max()), found.typical_mm]


def check_mm() -> list[float]:
    """Predicted rms error, mm, of the laboratory study's test positions, along x and y."""
    case = Case("", "", site_of())
    made = calibrated(case)
    _, test = head_positions_deg(POSITIONS, np.random.default_rng([SEED, 41]))
    covariances = []
    for pan_deg, tilt_deg in test:
        motion = case.planned.head_motion((float(pan_deg), float(tilt_deg)))
        row = predict_row(case.planned, made, motion)
        covariances.append(row.covariance_mm2(made.posterior, FrameNoise()))
    sigmas: list[float] = np.sqrt(np.diag(np.mean(covariances, axis=0))).tolist()
    return sigmas


def season_mm(kelvin: float, *, plate: bool, image_mm: float) -> float:
    """Sigma of y a month and a change of temperature after the calibration, by the budget, mm."""
    site = at_distance(site_of(), 22.0)
    scale = site.nominal_px_per_mm
    terms = stability_terms(site, scale, Moment(0.0, 0.0), Moment(86_400.0 * DAYS, kelvin))
    state = total_covariance(terms)
    target, other = _effects(np.zeros(2)), _effects(np.array([90.0 * scale, 0.0]))
    radius_px = np.hypot(15.0, 11.0) * scale  # of the plate's discs about its middle
    noise_px2 = (image_mm * scale) ** 2 * np.diag([1.0, 1.0, radius_px**-2, radius_px**-2])
    covariance = target @ state @ target.T
    if plate:
        cross = target @ state @ other.T
        covariance -= cross @ np.linalg.solve(other @ state @ other.T + noise_px2, cross.T)
        covariance += noise_px2
    return float(math.hypot(math.sqrt(covariance[1, 1]) / scale, image_mm))


def _effects(middle_px: FloatArray) -> FloatArray:
    """(4, 6): shift, turn and scale of a plate by the state, at the main target's distance."""
    x, y = middle_px
    effects = np.zeros((4, 6))
    effects[:2, :2] = effects[:2, 4:] = np.eye(2)
    effects[:2, 2], effects[:2, 3] = (-y, x), (x, y)
    effects[2, 2] = effects[3, 3] = 1.0
    return effects


def run(keep: Keep, *, only: int | None = None) -> Report:
    """Predict every cell, and compare one with rendered frames."""
    wanted = list(cases())[:only]
    found = []
    with progress(len(wanted), "sensitivity") as steps:
        for number, case in enumerate(wanted):
            name = f"{case.what}, {case.value}"
            found.append(keep.block(f"{number:02d}", {"cell": name}, partial(predict, case)))
            steps.next(name)
    checked = None if only else keep.block("check", {}, check_mm)
    laboratory = Keep(keep.directory.parent / "laboratory", ("studies/laboratory_frames.py",))
    given = {"positions": POSITIONS, "lens_views": LENS_VIEWS, "seed": SEED, "shrink": 1.0}
    rendered = None
    if checked is not None:
        take = partial(compute, POSITIONS, LENS_VIEWS, SEED)
        errors = laboratory.block("frames", given, take)["errors"]["dcam, rigid"]["mm"]
        rendered = np.sqrt(np.mean(np.array(errors) ** 2, axis=0)).tolist()
    return report(wanted, found, checked, rendered)


def report(
    wanted: list[Case],
    found: list[list[float]],
    predicted: list[float] | None,
    rendered: list[float] | None,
) -> Report:
    """Write the page."""
    rows = [
        (case.what, case.value, f"{still:.4f}", f"{drifted:.4f}")
        for case, (still, drifted) in zip(wanted, found, strict=True)
    ]
    at_22_m = next(f for c, f in zip(wanted, found, strict=True) if c.value == "22 m")[1]
    season = [
        (
            f"{kelvin:g} K",
            *(f"{season_mm(kelvin, plate=p, image_mm=at_22_m):.4f}" for p in (False, True)),
        )
        for kelvin in (0.0, 5.0, 10.0, 20.0)
    ]
    columns = ("what", "value", "sigma at rest, mm", "sigma within the drift, mm")
    tables = {
        "cells": Table(columns, tuple(rows)),
        "season": Table(("warmer by", "without a plate, mm", "with a plate, mm"), tuple(season)),
    }
    claims, checks = [], []
    pairs = zip(predicted or [], rendered or [], strict=True)
    for axis, (sigma_mm, rms_mm) in zip("xy", pairs, strict=False):
        ratio = rms_mm / sigma_mm
        checks.append((axis, f"{sigma_mm:.4f}", f"{rms_mm:.4f}", f"{ratio:.2f}"))
        sentence = f"rendered frames at 11 m err in {axis} by {ratio:.2f} of the predicted sigma"
        claims.append(Claim(sentence, 1.0 / CHECK_FACTOR / 2.0 < ratio < CHECK_FACTOR))
    tables["check"] = Table(("axis", "predicted, mm", "rendered, mm", "ratio"), tuple(checks))
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    return Report("sensitivity", "Sensitivity", text, tables, claims)
