"""The zero by rows before and after: right, to its sigma, for a bridge that breathes every day."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

import numpy as np

from core.arrays import FloatArray
from core.results import Displacement
from daemon.datum.across import by_rows_across, replacing
from daemon.datum.seen import SeenRow
from daemon.store.records import DatumMethod, DatumStep

NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)
OFFSET_MM = np.array([0.4, 7.0])
"""Of the later reference from the earlier one."""
TEN_MIN = timedelta(minutes=10)


def bridge_mm(when: datetime) -> FloatArray:
    """5 mm up and down in a day, and no day quite like another."""
    days = (when - NOON) / timedelta(days=1)
    wave = 5.0 * np.sin(2.0 * np.pi * days)
    return np.array([0.1 * wave, wave + 0.05 * np.sin(2.0 * np.pi * days / 5.3)])


def rows(
    since: datetime, until: datetime, calibration: int, offset_mm: FloatArray
) -> list[SeenRow]:
    """A row every ten minutes, with a further target that moves half as much."""
    rng, found = np.random.default_rng(calibration), []
    noise_mm2 = 1e-4 * np.eye(2)
    while since < until:
        mm = bridge_mm(since)
        main, quarter = (
            Displacement(part * mm - offset_mm + rng.normal(0.0, 0.01, 2), noise_mm2)
            for part in (1.0, 0.5)
        )
        found.append(SeenRow(since, main, calibration, (("quarter", quarter),)))
        since += TEN_MIN
    return found


def test_the_same_hour_of_another_day_carries_the_zero_over_a_gap_of_hours() -> None:
    """The bridge moves by millimetres in six hours, and hardly in a day."""
    before = rows(NOON - timedelta(days=20), NOON, 1, np.zeros(2))
    after = rows(NOON + timedelta(hours=6), NOON + timedelta(days=3), 2, OFFSET_MM)
    found = by_rows_across(before, after, 1)
    assert found is not None
    assert found.step.offset is not None
    assert re.match(r"by 24 pairs of rows before and after, \d d apart", found.words)
    assert (found.step.method, found.step.from_id) == (DatumMethod.ROWS, 1)
    for offset in (found.step.offset, found.step.targets["quarter"]):
        sigma_mm = np.sqrt(np.diag(offset.covariance_mm2))
        assert sigma_mm.max() < 0.15
        assert (np.abs(offset.mm - OFFSET_MM) < 3.0 * sigma_mm).all()


def test_within_minutes_the_rows_next_to_each_other_tell() -> None:
    before = rows(NOON - timedelta(days=4), NOON, 1, np.zeros(2))
    after = rows(NOON + timedelta(minutes=10), NOON + timedelta(minutes=40), 2, OFFSET_MM)
    found = by_rows_across(before, after, 1)
    assert found is not None
    assert found.step.offset is not None
    assert np.abs(found.step.offset.mm - OFFSET_MM).max() < 0.7


def test_without_rows_on_one_side_nothing_is_said() -> None:
    one = rows(NOON - timedelta(days=1), NOON, 1, np.zeros(2))
    assert by_rows_across(one, [], 1) is None
    assert by_rows_across([], one, 1) is None


def test_rows_on_both_sides_take_the_place_of_the_last_row_alone() -> None:
    """Both rest on that row: together they would count it twice. What else is known stays."""
    wide, narrow = (Displacement(np.zeros(2), s**2 * np.eye(2)) for s in (1.0, 0.1))
    fixed = DatumStep(DatumMethod.FIXED_TARGETS, 1, wide)
    last = DatumStep(DatumMethod.ROWS, 1, wide, {"pier": wide})
    better = DatumStep(DatumMethod.ROWS, 1, narrow, {})
    steps = replacing((fixed, last), better)
    assert steps[0] == fixed
    assert steps[1].offset is None
    assert dict(steps[1].targets) == {"pier": wide}
    assert steps[2] == better
