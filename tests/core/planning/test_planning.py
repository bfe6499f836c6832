"""What is predicted from a drawing against what simulated sites, built otherwise, then measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks import made_sites
from benchmarks.sites import Row, measured
from core.arrays import FloatArray
from core.calibration.views import ViewRole
from core.planning.planned_site import CalibrationPlan, ImageQuality, PlannedSite
from core.planning.predicted_accuracy import (
    FrameNoise,
    drift_rows,
    error_causes,
    predict_accuracy,
    predict_calibration,
)
from core.site import QualityLimits
from tests.exhaustive import one_of

SITES = 5
QUALITY = ImageQuality(
    made_sites.CONTRAST_DN, made_sites.NOISE_DN, made_sites.BLUR_PX, fit_loss=1.0
)
"""As the simulated sites see."""
DRIFT = QualityLimits(expected_drift_mrad=1.6, expected_drift_mm=2.4)
"""As far as the simulated sites drift."""


def drawn(case: made_sites.Case, seed: int) -> tuple[PlannedSite, CalibrationPlan]:
    """A simulated site as drawn, and its calibration."""
    site = replace(made_sites.make_site(case, seed)[0], quality=DRIFT)
    taken = list(made_sites.shots(case, site, seed))
    positions = tuple(shot.head_deg for shot in taken if shot.role is ViewRole.RIG)
    lens_views = sum(shot.role is ViewRole.INTRINSICS for shot in taken)
    return PlannedSite(site, QUALITY), CalibrationPlan(lens_views, positions)


def stated_mm(rows: Sequence[Row]) -> FloatArray:
    """(2,) rms of the sigmas that rows carry."""
    return np.sqrt(np.mean([np.diag(row.covariance_mm2) for row in rows], axis=0))


@dataclass(frozen=True, slots=True)
class Compared:
    """One site: the sigma predicted, and its rows, with noise of their own and without."""

    predicted_mm: FloatArray
    """(2,) of x and y for the rig anywhere within the drift."""
    rows: tuple[Row, ...]
    predicted_quiet_mm: FloatArray
    quiet_rows: tuple[Row, ...]


@pytest.fixture(scope="module", params=["lab", "field"][:: one_of(2)])
def compared(request: pytest.FixtureRequest) -> list[Compared]:
    """Some sites."""
    case, found = made_sites.Case(request.param, shrink=4.0), []
    for seed in range(1, SITES + 1, one_of(2)):
        planned, calibration_plan = drawn(case, seed)
        calibrated = predict_calibration(planned, calibration_plan)
        rows, posterior = drift_rows(planned, calibrated), calibrated.posterior
        made = made_sites.make_numbers(case, seed)
        found.append(
            Compared(
                predict_accuracy(rows, posterior, FrameNoise()).drifted_mm,
                measured(made, made.pairs, quiet=False),
                predict_accuracy(rows, posterior, FrameNoise(0.0, 0.0)).drifted_mm,
                measured(made, made_sites.quiet_pairs(made, case), quiet=True),
            )
        )
    return found


def test_sites_measure_as_predicted(compared: list[Compared]) -> None:
    """Each site's rows say the sigma that was predicted; together they err by as much."""
    errors = []
    for one in compared:
        assert one.predicted_mm == pytest.approx(stated_mm(one.rows), rel=0.2)
        errors.append([row.error_mm / one.predicted_mm for row in one.rows])
    assert 1.0 / 1.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_calibrations_know_as_much_as_predicted(compared: list[Compared]) -> None:
    """Likewise the calibration's part alone, mostly smaller than a row's own noise."""
    for one in compared:
        ratio = one.predicted_quiet_mm / stated_mm(one.quiet_rows)
        assert (ratio > 1.0 / 1.5).all()
        assert (ratio < 1.5).all()


def test_a_cause_taken_away_leaves_what_was_said() -> None:
    """What is predicted without a cause is predicted of a site that has it not."""
    planned, calibration_plan = drawn(made_sites.Case("field", shrink=4.0), 1)
    calibrated = predict_calibration(planned, calibration_plan)
    rows = drift_rows(planned, calibrated)
    now = predict_accuracy(rows, calibrated.posterior).typical_mm
    without = {limit.cause: limit.without_mm for limit in error_causes(planned, calibrated, rows)}
    known = replace(planned.site.rig, rotation_sigma_deg=1e-5)
    other = replace(planned, site=replace(planned.site, rig=known))
    again = predict_calibration(other, calibration_plan)
    left = predict_accuracy(drift_rows(other, again), again.posterior).typical_mm
    assert left < 0.99 * now
    assert without["rotation between the cameras"] == pytest.approx(left, rel=1e-3)
    assert min(without, key=without.__getitem__) == "noise of a frame's pose (sub-camera)"
