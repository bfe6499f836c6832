"""Slips of the board that no single row can tell, and motions that are none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from core.arrays import FloatArray
from core.quality.step_detection import RowSummary, StepDetector, summarise_row
from core.results import Reason
from core.site import QualityLimits
from tests.core.scenes import MINUTE
from tests.core.sessions import Session

SIGMA_MM = 0.01
Rows = tuple[FloatArray, FloatArray, FloatArray]
"""False displacement, its part from sliding, and true displacement, each (n, 2) mm."""


def wander(rng: np.random.Generator, n: int, period: float, size: float) -> FloatArray:
    """Slow waves (n, 2), periods in rows."""
    omega = 2.0 * np.pi / (period * np.exp(rng.uniform(-0.9, 0.9, (2, 4))))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 4))
    return size * np.sin(omega * np.arange(n)[:, None, None] + phase).mean(axis=2)


def pier(rng: np.random.Generator, n: int) -> Rows:
    """A row a minute: 1 mrad and 1.5 mm of drift in half a day, a bridge with traffic."""
    slide = wander(rng, n, 720.0, 1.5)
    bridge = wander(rng, n, 1440.0, 5.0) + 0.3 * rng.standard_t(3, (n, 2))
    return wander(rng, n, 720.0, 11.0) + slide, slide, bridge


def upright(rng: np.random.Generator, n: int) -> Rows:
    """As `pier`, with a bridge that moves sideways ten times less than up and down."""
    false, slide, bridge = pier(rng, n)
    return false, slide, bridge * np.array([0.1, 1.0])


def hourly(rng: np.random.Generator, n: int) -> Rows:
    """A row an hour at 22 m: rig and bridge move by millimetres from row to row."""
    slide = wander(rng, n, 12.0, 1.5)
    return wander(rng, n, 12.0, 22.0) + slide, slide, wander(rng, n, 24.0, 5.0)


def laboratory(rng: np.random.Generator, n: int) -> Rows:
    """A head that jumps by a milliradian from row to row, a target at rest."""
    turns = rng.uniform(-1.0, 1.0, (n, 2))
    return 11.05 * turns, 0.05 * turns, np.zeros((n, 2))


def anywhere(rng: np.random.Generator, n: int) -> Rows:
    """Rig and bridge wherever they like in each row."""
    slide = rng.uniform(-10.0, 10.0, (n, 2))
    return rng.uniform(-11.0, 11.0, (n, 2)) + slide, slide, rng.uniform(-5.0, 5.0, (n, 2))


def judged(
    rows: Rows, rng: np.random.Generator, slip_mm: FloatArray, when: slice = slice(0, 0)
) -> list[tuple[Reason, ...]]:
    """The reasons of rows while the board sits elsewhere for some of them."""
    false, slide, true = rows
    shifted = np.zeros_like(true)
    shifted[when] = slip_mm
    noise = rng.normal(0.0, SIGMA_MM / 2, true.shape)
    state, reasons = StepDetector(), []
    for k in range(len(true)):
        now = RowSummary(
            60.0 * k,
            true[k] - shifted[k] - noise[k],
            false[k] + shifted[k] + noise[k],
            slide[k] + shifted[k],
            np.full(3, SIGMA_MM),
            1.0,
            trusted=True,
        )
        said, state = state.judge(now, QualityLimits())
        reasons.append(said)
    return reasons


@pytest.mark.parametrize(
    ("kind", "rows", "sets"),
    [(pier, 600, 10), (upright, 600, 10), (hourly, 12, 150), (laboratory, 12, 150)],
)
def test_what_moves_as_it_always_did_is_no_slip(kind: Callable[..., Rows], rows: int, sets: int):
    rng = np.random.default_rng(3)
    flagged = sum(any(judged(kind(rng, rows), rng, np.zeros(2))) for _ in range(sets))
    assert flagged <= 0.01 * sets


@pytest.mark.parametrize("known", [5, 10, 30])
def test_what_went_on_in_a_gap_longer_than_the_rows_before_is_no_slip(known: int):
    """Rig and bridge drift against each other, evenly; half an hour of darkness lies between."""
    state = StepDetector()
    for minute in [*range(known), *range(known + 30, known + 60)]:
        level = np.array([0.02, 0.05]) * minute
        now = RowSummary(
            60.0 * minute, -level, level, 0.1 * level, np.full(3, SIGMA_MM), 1.0, trusted=True
        )
        said, state = state.judge(now, QualityLimits())
        assert said == ()


def test_rows_at_random_are_rarely_taken_for_a_slip():
    rng = np.random.default_rng(4)
    rows = [row for _ in range(300) for row in judged(anywhere(rng, 12), rng, np.zeros(2))]
    assert np.mean([bool(row) for row in rows]) < 0.005


@pytest.mark.parametrize(
    ("kind", "rows", "slip_mm", "share"),
    [
        (pier, 300, 4.0, 0.9),
        (upright, 300, 0.5, 0.65),
        (hourly, 14, 2.0, 0.8),
        (hourly, 14, 4.0, 0.95),
        (laboratory, 12, 0.7, 1.0),
        (laboratory, 12, 2.0, 1.0),
    ],
)
def test_a_slip_is_reported_until_it_is_undone(
    kind: Callable[..., Rows], rows: int, slip_mm: float, share: float
):
    rng, reported, after = np.random.default_rng(5), [], []
    for _ in range(60):
        angle = rng.integers(4) * np.pi / 2.0
        slip = slip_mm * np.array([np.cos(angle), np.sin(angle)])
        reasons = judged(kind(rng, rows), rng, slip, slice(rows - 7, rows - 3))
        reported += [said == (Reason.BOARD_SLIPPED,) for said in reasons[-7:-3]]
        after += [said == () for said in reasons[-3:]]
    assert np.mean(reported) >= share
    assert np.mean(after) > 0.97


def samples(count: int, **changes: object) -> list[RowSummary]:
    at_rest = {"mm": np.zeros(2), "false_mm": np.zeros(2), "slide_mm": np.zeros(2)}
    fields = {**at_rest, "sigma_mm": np.full(3, SIGMA_MM), "residual_ratio": 1.0, "trusted": True}
    return [RowSummary(time_s=60.0 * k, **{**fields, **changes}) for k in range(count)]


def test_corners_that_fit_badly_for_long_are_reported():
    state, said = StepDetector(), ()
    for row in samples(40, residual_ratio=2.3):
        said, state = state.judge(row, QualityLimits())
    assert said == (Reason.CALIBRATION_DRIFTING,)
    assert state.residual_ratio == pytest.approx(2.3)


def test_a_target_that_moves_faster_than_it_may_is_reported():
    state = StepDetector()
    for row in samples(10):
        _, state = state.judge(row, QualityLimits(max_step_mm=2.0))
    jumped = RowSummary(
        600.0, np.array([0.0, 2.5]), *(np.zeros(2),) * 2, np.full(3, SIGMA_MM), 1.0, True
    )
    assert state.judge(jumped, QualityLimits())[0] == ()
    assert state.judge(jumped, QualityLimits(max_step_mm=2.0))[0] == (Reason.CAMERA_BUMPED,)


@pytest.mark.parametrize("squares", [(1, 0), (2, 0), (0, 2), (-3, 0), (0.35, 0.0), (0.0, 0.5)])
def test_rendered_boards_that_slipped_are_never_good(usual: Session, squares: tuple[float, float]):
    """Ten rows, four minutes apart; the board slips after six of them."""
    site, state, flagged = usual.with_world(), StepDetector(), []
    for k in range(10):
        site.world.slip_board(*(2.0 * np.array(squares) * (k >= 6)))
        row = site.row(site.world.settings.start_utc + (60 + 4 * k) * MINUTE)
        now = summarise_row(site.calibration.calibrated, row.measurement, 240.0 * k)
        said = ()
        if now is not None:
            said, state = state.judge(now, site.site.quality)
        flagged.append(bool(said or row.measurement.reasons))
    assert flagged == [False] * 6 + [True] * 4
