"""Which answer is believed: what contradicts the board, what a changed lens shows, who is left."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from core.calibration.calibrate import Calibration
from core.geometry.lens import Lens
from core.images import GreyImage
from core.results import Displacement, Flag, Measurement, RigMotion
from core.rig.calibrated_target import CalibratedTarget
from core.site import CirclesTarget, ExtraTarget, TargetRole
from daemon.config.reading import load_config
from daemon.datum.candidates import (
    Candidate,
    by_fixed_targets,
    by_rows,
    candidate,
    drift_beyond,
    lens_changes,
    lost,
)
from daemon.datum.chain import origin
from daemon.datum.choice import choose, judged
from daemon.datum.seen import Known, NewReference, SeenRow
from daemon.slots.measuring import ActiveCalibration
from daemon.store.database import open_store_readonly
from daemon.store.records import DatumMethod, DatumStep
from tests.daemon.commands.conftest import bench, calibrated

__all__ = ["bench", "calibrated"]

NOW = datetime(2026, 6, 1, tzinfo=UTC)
BASE = {1: origin(NOW, NOW)}


def answer(method: DatumMethod, y_mm: float, sigma_mm: float, *doubts: str) -> Candidate:
    offset = Displacement(np.array([0.0, y_mm]), sigma_mm**2 * np.eye(2))
    return candidate(DatumStep(method, 1, offset), BASE[1], method.value, doubts)


OLD, FIXED, ROWS = DatumMethod.OLD_CALIBRATION, DatumMethod.FIXED_TARGETS, DatumMethod.ROWS


@pytest.fixture(scope="module")
def made(calibrated: Path) -> Calibration:
    with open_store_readonly(calibrated) as store:
        record = store.active_calibration()
    assert record is not None
    return record.calibration


def test_the_least_sigma_of_those_believed_is_taken() -> None:
    both = [answer(OLD, 2.75, 0.03), answer(FIXED, 2.74, 0.02), answer(ROWS, 3.0, 1.0)]
    assert choose(judged(both)) == judged(both)[1]
    assert choose([answer(OLD, 0.0, 0.1, "no"), answer(ROWS, 0.0, 5.0)]).step.method is ROWS
    assert choose([answer(OLD, 0.0, 0.1, "no")]) is None


@pytest.mark.parametrize(("by", "sigma_mm"), [(FIXED, 0.05), (ROWS, 0.3)])
def test_the_board_is_not_believed_against_others(by: DatumMethod, sigma_mm: float) -> None:
    """It was bonded again, and says 2 mm less."""
    old, other = judged([answer(OLD, 0.75, 0.02), answer(by, 2.75, sigma_mm)])
    assert "contradicts it" in old.doubts[0]
    assert choose([old, other]) is other


def test_a_wide_answer_contradicts_nothing() -> None:
    old, other = judged([answer(OLD, 0.75, 0.02), answer(ROWS, 2.75, 1.0)])
    assert choose([old, other]) is old


def test_another_lens_is_noticed_and_the_same_one_calibrated_again_is_not(
    made: Calibration,
) -> None:
    site, lens = made.calibrated, made.calibrated.lens
    assert lens_changes(site, site) == []

    def with_lens(change: np.ndarray) -> list[str]:
        parameters = lens.parameters.copy()
        parameters[:5] += change
        return lens_changes(site, replace(site, lens=Lens(parameters, lens.model)))

    focal_px = lens.parameters[0]
    assert "focal length" in with_lens(np.array([0.01 * focal_px, 0.01 * focal_px, 0, 0, 0]))[0]
    assert "principal point" in with_lens(np.array([0, 0, 0, 12.0, 0]))[0]
    assert with_lens(np.array([0.0005 * focal_px, 0.0005 * focal_px, 0, 0.2, 0.2])) == []
    assert "main camera's scale" in lens_changes(site, replace(site, B=1.01 * site.B))[0]


def test_a_rig_that_would_have_drifted_too_far_is_a_board_that_was_moved(bench: Path) -> None:
    site = load_config(bench / "dcam.toml").site()

    def moved(turns_mrad: list[float], shifts_mm: list[float]) -> list[str]:
        motion = RigMotion(1e-3 * np.array(turns_mrad), np.array(shifts_mm), np.eye(6))
        return drift_beyond(Measurement(Flag.GOOD, (), None, None, motion), site)

    still = [0.0, 0.0, 0.0]
    # As expected along each axis: 1.6 mrad and 2.2 mm in all.
    assert moved([0.9, -0.9, 0.9], [-1.3, 1.4, 1.1]) == []
    (turned,) = moved([0.0, 0.0, -3.0], still)
    assert "turned by 3.00 mrad about one axis, [quality] expected_drift_mrad = 1" in turned
    (shifted,) = moved(still, [0.0, 2.0, 0.0])
    assert "moved by 2.00 mm along one axis, [quality] expected_drift_mm = 1.5" in shifted


def test_a_row_carries_the_zero_with_the_bridge_s_own_movement_as_sigma() -> None:
    rng = np.random.default_rng(1)
    mm = np.cumsum(rng.normal(0.0, 0.02, (3000, 2)), axis=0)
    rows = [
        SeenRow(NOW + k * timedelta(minutes=1), Displacement(one, 1e-4 * np.eye(2)), 1)
        for k, one in enumerate(mm)
    ]
    found = by_rows(rows, BASE, rows[-1].slot_utc + timedelta(minutes=100))
    assert found is not None
    assert found.offset.mm == pytest.approx(mm[-1])
    assert found.sigma_mm == pytest.approx([0.2, 0.2], rel=0.4)
    assert by_rows(rows[:2], BASE, NOW + timedelta(hours=1)) is None


def test_a_lost_zero_may_be_anywhere_in_the_image(bench: Path) -> None:
    site = load_config(bench / "dcam.toml").site()
    found = lost(1, None, site, BASE)
    width_mm = site.main.width_px / site.nominal_px_per_mm
    assert found.sigma_mm[0] == pytest.approx(width_mm / 12**0.5)
    assert found.offset.mm.tolist() == [0.0, 0.0]
    assert "THE ZERO IS LOST" in found.words
    assert "dcam-ctl datum set" in found.words


@pytest.mark.parametrize(("spread_mm", "expected_mm"), [(0.0, 0.1), (0.36, 0.239)])
def test_through_a_fixed_target_a_rig_that_wanders_has_a_wider_zero(
    bench: Path, made: Calibration, spread_mm: float, expected_mm: float
) -> None:
    """Rows days apart show where the rig can be: of that the hour since the last brings a part."""
    site, old = load_config(bench / "dcam.toml").site(), made.calibrated
    beside = CirclesTarget(site.main_target.centres_mm, np.full(5, 8.0), 11125.0, 20.0)
    site = replace(site, extra_targets=(ExtraTarget("pier", TargetRole.FIXED, beside),))
    places_px = old.reference_discs_px + np.array([120.0, 10.0])
    plate = CalibratedTarget(
        "pier", TargetRole.FIXED, places_px, np.full(5, 1e-7), old.B, 11125.0, 20.0
    )
    calibration = replace(made, calibrated=replace(old, further=(plate,)))
    hours = [*(72.0 * k for k in range(19, 0, -1)), 1.0]
    still = Displacement(np.zeros(2), 1e-6 * np.eye(2))
    rows = [
        SeenRow(
            NOW - timedelta(hours=before),
            still,
            1,
            motion=RigMotion(np.zeros(3), side * np.full(3, spread_mm), np.eye(6)),
        )
        for before, side in zip(hours, [-1.0, 1.0] * 10, strict=True)
    ]
    known = Known(ActiveCalibration(1, calibration), NOW - timedelta(days=60))
    sub = GreyImage(np.zeros((2, 2), np.uint8))  # it is not looked at
    new = NewReference(NOW, None, sub, calibration, None, None)
    found = by_fixed_targets(known, new, site, rows)
    assert found is not None
    assert found.sigma_mm == pytest.approx([expected_mm * 125.0 / 11125.0] * 2, rel=0.3)
