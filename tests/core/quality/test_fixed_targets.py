"""A fixed target that moves by itself is told from a rig that bends."""

from __future__ import annotations

import numpy as np
import pytest

from core.moment import Moment
from core.quality.fixed_targets import PastRow, moved_alone, not_believed_any_more
from core.results import Displacement, Flag, Measurement, Reason, TargetMeasurement
from core.site import TargetRole
from tests.core.sessions import Session

NAME = "abutment"


def row(
    minute: float, closure_mm: float, bridge_mm: float, *, moved: bool = False, kelvin: float = 0.0
) -> PastRow:
    """A row whose fixed target seems to be closure_mm up, and whose bridge is bridge_mm up."""

    def up(mm: float) -> Displacement:
        return Displacement(np.array([0.0, mm]), 0.002**2 * np.eye(2))

    reasons = (Reason.FIXED_TARGET_MOVED,) if moved else ()
    fixed = TargetMeasurement(
        NAME, TargetRole.FIXED, Flag.GOOD, reasons, up(closure_mm), up(closure_mm)
    )
    closure = None if moved else up(closure_mm)
    measurement = Measurement(
        Flag.GOOD, (), up(bridge_mm), up(0.0), None, closure=closure, targets=(fixed,)
    )
    return PastRow(Moment(60.0 * minute, 15.0 + kelvin), measurement)


def past(count: int, bridge_mm: float = 0.02) -> list[PastRow]:
    rng = np.random.default_rng(7)
    return [
        row(k, 0.3 + 0.002 * rng.normal(), 5.0 + bridge_mm * rng.normal()) for k in range(count)
    ]


def judged(rows: list[PastRow], now: PastRow, made: Session) -> frozenset[str]:
    calibrated = made.calibration.calibrated
    return moved_alone(rows, now.measurement, now.moment, made.site, calibrated)


def test_a_knock_that_the_bridge_does_not_share_is_the_targets_own(usual: Session) -> None:
    assert judged(past(20), row(20, 0.6, 4.7), usual) == {NAME}


def test_a_bend_that_all_targets_share_is_not(usual: Session) -> None:
    """The value with the closure off stays: the main target has jumped as the fixed one did."""
    assert judged(past(20), row(20, 0.6, 5.0), usual) == frozenset()


def test_noise_and_slow_bending_are_no_knock(usual: Session) -> None:
    rows = past(20)
    assert judged(rows, row(20, 0.304, 5.01), usual) == frozenset()
    assert judged(rows[:3], row(3, 0.303, 5.02), usual) == frozenset()


def test_after_five_rows_it_is_out_for_good(usual: Session) -> None:
    rows = past(20)
    knocked = [row(20 + k, 0.6, 5.0, moved=True) for k in range(5)]
    assert not_believed_any_more([*rows, *knocked[:4]]) == frozenset()
    assert not_believed_any_more([*rows, *knocked]) == {NAME}


def test_one_bad_row_does_not_lose_it(usual: Session) -> None:
    rows = [*past(20), row(20, 0.6, 5.0, moved=True)]
    assert judged(rows, row(21, 0.301, 5.0), usual) == frozenset()
    assert judged(rows, row(21, 0.6, 4.7), usual) == {NAME}


@pytest.mark.parametrize("bridge_mm", [0.01, 0.05])
def test_no_false_alarm_in_a_day_of_a_lively_bridge(usual: Session, bridge_mm: float) -> None:
    rows = past(1440, bridge_mm)
    alarms = [judged(rows[max(0, k - 60) : k], rows[k], usual) for k in range(2, len(rows), 5)]
    assert not any(alarms)
