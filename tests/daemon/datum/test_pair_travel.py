"""How far the pair has moved to a new reference, in mm, by rows and by a fixed target's image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from core.arrays import FloatArray
from core.calibration.calibrate import Calibration
from core.geometry.pose import Pose
from core.images import GreyImage
from core.results import Displacement, RigMotion
from core.rig.calibrated_site import CalibratedSite
from core.rig.calibrated_target import CalibratedTarget
from core.rig.propagation import predict_shift_of
from core.rig.travel import Travel, travel_by
from core.site import Site, TargetRole
from daemon.config.reading import load_config
from daemon.datum.pair_travel import pair_travel
from daemon.datum.seen import Known, NewReference, SeenRow
from daemon.slots.measuring import ActiveCalibration
from daemon.store.database import open_store_readonly
from tests.daemon.commands.conftest import bench, calibrated

__all__ = ["bench", "calibrated"]

NOW = datetime(2026, 6, 1, tzinfo=UTC)
PIVOT_MM = np.array([30.0, 900.0, -250.0])
"""From the sub-camera to what the rig turns about, as a bracket on a pier may be: 1 mm a mrad."""
HOURS = [*(72.0 * k for k in range(9, 0, -1)), 1.5]
"""Of rows before the new reference."""


@dataclass(frozen=True)
class Record:
    """A calibrated site with a fixed plate, and rows of a rig that moves."""

    site: Site
    known: Known
    rows: list[SeenRow]

    @property
    def old(self) -> CalibratedSite:
        return self.known.active.calibration.calibrated

    def travel(self, motion: FloatArray, image_px: float = 0.0) -> Travel | None:
        """As found for a new reference after a motion (6,), its image shifted by so much more."""
        plate = self.old.further[0]
        shift = predict_shift_of(self.old, plate, np.arange(5), pose(motion)).shift_px
        seen = replace(plate, reference_px=plate.reference_px + shift + image_px)
        made = replace(self.known.active.calibration, calibrated=replace(self.old, further=(seen,)))
        sub = GreyImage(np.zeros((2, 2), np.uint8))  # it is not looked at
        return pair_travel(
            self.known, NewReference(NOW, None, sub, made, None, None), self.site, self.rows
        )

    def truth_mm(self, motion: FloatArray) -> FloatArray:
        true = travel_by(self.old, pose(motion), 0.0)
        assert true is not None
        return true.mm


def pose(motion: FloatArray) -> Pose:
    return Pose.from_vectors(motion[:3], motion[3:])


def pivoting(turn_rad: FloatArray) -> FloatArray:
    """(6,) the motion of a rig that turns about its mount."""
    return np.concatenate([turn_rad, np.cross(PIVOT_MM, turn_rad)])


@pytest.fixture
def record(bench: Path, calibrated: Path) -> Callable[[FloatArray], Record]:
    """Make a record with rows of these motions (10, 6)."""
    with open_store_readonly(calibrated) as store:
        stored = store.active_calibration()
    assert stored is not None
    made: Calibration = stored.calibration
    old = made.calibrated
    places_px = old.reference_discs_px + np.array([120.0, 10.0])
    plate = CalibratedTarget(
        "pier", TargetRole.FIXED, places_px, np.full(5, 1e-7), old.B, 11125.0, 20.0
    )
    calibration = replace(made, calibrated=replace(old, further=(plate,)))
    known = Known(ActiveCalibration(1, calibration), NOW - timedelta(days=60))
    still = Displacement(np.zeros(2), 1e-6 * np.eye(2))

    def with_rows(motions: FloatArray) -> Record:
        rows = [
            SeenRow(
                NOW - timedelta(hours=hours),
                still,
                1,
                motion=RigMotion(motion[:3], motion[3:], 1e-12 * np.eye(6)),
                closure=still,
            )
            for hours, motion in zip(HOURS, motions, strict=True)
        ]
        return Record(load_config(bench / "dcam.toml").site(), known, rows)

    return with_rows


def turns(seed: int) -> FloatArray:
    return np.random.default_rng(seed).normal(0.0, 3e-4, (10, 3))


def test_a_rig_that_has_not_turned_has_not_moved(record: Callable[..., Record]) -> None:
    """0.3 mm of movement from row to row, and none in the hour since the last one."""
    motions = np.array([pivoting(turn) for turn in turns(1)])
    made = record(motions)
    found = made.travel(motions[-1])
    assert found is not None
    assert found.sigma_mm < 0.04
    np.testing.assert_allclose(found.mm, made.truth_mm(motions[-1]), atol=0.001)


def test_a_rig_that_has_turned_since_has_moved_as_it_does(record: Callable[..., Record]) -> None:
    motions = np.array([pivoting(turn) for turn in turns(1)])
    made = record(motions)
    new = pivoting(turns(1)[-1] + np.array([4e-4, 3e-4, 2e-4]))
    moved_mm = made.truth_mm(new) - made.truth_mm(motions[-1])
    assert np.hypot(*moved_mm) > 0.1
    found = made.travel(new)
    assert found is not None
    assert found.sigma_mm < 0.04
    np.testing.assert_allclose(found.mm, made.truth_mm(new), atol=0.003)


@pytest.mark.parametrize("seed", range(1, 6))
def test_what_a_turn_does_not_tell_stays_uncertain(record: Callable[..., Record], seed) -> None:
    """A rig that also slides by 0.3 mm of its own: the line through ten rows promises nothing."""
    slides = np.random.default_rng(100 + seed).normal(0.0, 0.3, (10, 3))
    motions = np.array([pivoting(turn) for turn in turns(seed)])
    motions[:, 3:] += slides
    found = record(motions).travel(motions[-1])
    assert found is not None
    assert 0.08 < found.sigma_mm < 0.6


def test_a_camera_that_was_replaced_shows_no_turn(record: Callable[..., Record]) -> None:
    """Its image lies elsewhere by 400 px: the rows alone are believed, and a movement since."""
    motions = np.array([pivoting(turn) for turn in turns(1)])
    made = record(motions)
    found = made.travel(motions[-1], image_px=400.0)
    assert found is not None
    assert found.sigma_mm > 0.08
    np.testing.assert_allclose(found.mm, made.truth_mm(motions[-1]), atol=0.001)
