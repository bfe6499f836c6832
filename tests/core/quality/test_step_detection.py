"""Slips of the board that no single row can tell, and motions that are none."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import slip_bridges as bridges
from benchmarks.slip import power, row_chances, short_set_chances
from benchmarks.slip_bridges import BRIDGES, Simulate
from core.arrays import FloatArray
from core.quality.opposed_steps import (
    BLOCK_ROWS,
    RAREST,
    ROWS_A_FALSE_ALARM,
    TAIL_POWER,
    chance_of,
    chance_of_product,
)
from core.quality.row_series import RowSeries, RowSummary, summarise_row
from core.quality.step_detection import SETTLED_ROWS, USUAL_ROWS, StepDetector
from core.results import Reason
from core.site import QualityLimits
from tests.core.scenes import MINUTE
from tests.core.sessions import Session
from tests.exhaustive import one_of

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


@pytest.mark.parametrize("simulate", BRIDGES, ids=lambda simulate: simulate.__name__)
def test_clean_rows_of_any_bridge_are_no_slip(simulate: Simulate):
    """The stated rate is shown over years by `benchmarks.slip`; here over five days of each."""
    chances = row_chances(simulate(np.random.default_rng(21), 7000).rows())
    assert chances.min() > 1.0 / ROWS_A_FALSE_ALARM
    assert (chances < 1e-3).sum() <= 7


@pytest.mark.parametrize(
    ("kind", "rows", "sets"), [(pier, 200, 5), (upright, 200, 5), (hourly, 12, 150)]
)
def test_what_moves_as_it_always_did_is_no_slip(kind: Callable[..., Rows], rows: int, sets: int):
    rng = np.random.default_rng(3)
    assert not any(
        any(judged(kind(rng, rows), rng, np.zeros(2))) for _ in range(0, sets, one_of(3))
    )


@pytest.mark.parametrize("rows", [8, 30])
def test_the_chance_of_a_step_is_no_smaller_than_it_says(rows: int):
    """Pareto's distribution: as heavy a tail as is allowed for."""
    steps = 1.0 + np.random.default_rng(6).pareto(TAIL_POWER, (60_000 // one_of(3), rows + 1))
    chances = np.array([chance_of(step[0], step[1:], rows, 0.0, TAIL_POWER) for step in steps])
    for limit in (0.1, 0.01, 0.001):
        assert np.mean(chances <= limit) < limit + 4.0 * np.sqrt(limit / len(chances))


@pytest.mark.parametrize("rows", [3, 6, 10])
def test_short_sets_raise_no_false_alarm(rows: int):
    """Rig and bridge walk at random, tails of Student's t of 3."""
    chances = short_set_chances(rows, 50_000, seed=3)
    assert chances.min() > 1.0 / ROWS_A_FALSE_ALARM
    assert (chances <= 1e-3).sum() <= 50


def test_two_independent_chances_have_so_small_a_product_as_seldom_as_said():
    both = np.random.default_rng(7).uniform(size=(2_000_000, 2)).clip(RAREST, None).prod(axis=1)
    for product in (1e-3, 1e-4, 1e-5):
        assert np.mean(both <= product) == pytest.approx(2.0 * chance_of_product(product), rel=0.1)


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


def test_rows_at_random_are_never_taken_for_a_slip():
    rng = np.random.default_rng(4)
    assert not any(
        any(judged(anywhere(rng, 12), rng, np.zeros(2))) for _ in range(0, 300, one_of(3))
    )


@pytest.mark.parametrize(
    ("simulate", "slip_mm", "at_once", "later"),
    [
        (bridges.quiet, 0.2, 0.95, 0.95),
        (bridges.vibrating, 2.0, 0.7, 0.9),
        (bridges.opposed_warmth, 1.0, 0.95, 0.95),
        (bridges.traffic, 10.0, 0.6, 0.8),
        (bridges.nights, 10.0, 0.6, 0.8),
        (bridges.hourly, 20.0, 0.8, 0.9),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_slip_that_is_large_for_its_bridge_is_seen(
    simulate: Simulate, slip_mm: float, at_once: float, later: float
):
    shares = power(simulate, slip_mm, USUAL_ROWS, seed=5, trials=25)
    assert shares[0] >= at_once
    assert shares[1] >= later


@pytest.mark.parametrize("slip_mm", [0.7, 2.0])
def test_a_slip_is_reported_until_it_is_undone(slip_mm: float):
    """The laboratory: a dozen rows, a target at rest."""
    rng = np.random.default_rng(5)
    for _ in range(0, 60, one_of(3)):
        angle = rng.integers(4) * np.pi / 2.0
        slip = slip_mm * np.array([np.cos(angle), np.sin(angle)])
        reasons = judged(laboratory(rng, 12), rng, slip, slice(8, 10))
        assert [bool(said) for said in reasons] == [False] * 8 + [True] * 2 + [False] * 2


def quiet_day(
    n: int = USUAL_ROWS, seed: int = 8
) -> tuple[RowSeries, Callable[[int, float, float], RowSummary]]:
    """A day of a quiet bridge, and what makes later rows of it: number, rig and bridge (mm, y)."""
    rng = np.random.default_rng(seed)

    def at(k: int, rig_mm: float = 0.0, bridge_mm: float = 0.0) -> RowSummary:
        noise, moved = rng.normal(0.0, SIGMA_MM / 2, (2, 2))
        mm, false_mm = np.array([[0.0, bridge_mm], [0.0, rig_mm]])
        now = mm + 3.0 * moved - noise, false_mm + noise, 0.1 * false_mm
        return RowSummary(60.0 * k, *now, np.full(3, SIGMA_MM), 1.0, trusted=True)

    return RowSeries.of(*(at(k - n) for k in range(n))), at


def marked(state: StepDetector, rows: Iterable[RowSummary]) -> tuple[list[bool], StepDetector]:
    """Which of some rows are marked as slipped, and the state after them."""
    found = []
    for row in rows:
        reasons, state = state.judge(row, QualityLimits())
        found.append(Reason.BOARD_SLIPPED in reasons)
    return found, state


def test_a_slip_stands_for_as_long_as_it_lasts_and_ends_with_it():
    day, at = quiet_day()
    slipped = [at(k, 1.0, -1.0) for k in range(300)]
    found, state = marked(StepDetector(day), [*slipped, *(at(300 + k) for k in range(5))])
    assert found == [True] * 300 + [False] * 5
    assert state.slip is None


def test_a_board_put_back_to_another_place_stays_suspect():
    day, at = quiet_day()
    _, state = marked(StepDetector(day), [at(k, 1.0, -1.0) for k in range(30)])
    assert all(marked(state, [at(30 + k, 0.4, -0.4) for k in range(40)])[0])


def test_a_false_alarm_is_taken_back_when_the_bridge_shows_that_it_was_one():
    """The rig moves for good; at the same time the bridge moves against it, for five rows."""
    day, at = quiet_day()
    rows = [at(k, 1.0, -1.0 if k < 5 else 0.0) for k in range(60)]
    found, _ = marked(StepDetector(day), rows)
    assert all(found[:5])
    assert not any(found[12:])


def test_it_goes_on_from_stored_rows_as_if_it_had_never_stopped():
    day, at = quiet_day()
    slipped = [at(k, 1.0, -1.0) for k in range(200)]
    back = [at(200 + k) for k in range(3)]
    for stop in (1, 5, 40, 119, 120, 121, 200):
        rows = RowSeries.of(*slipped[:stop])
        kept = rows if stop <= SETTLED_ROWS else rows[:1].followed_by(rows[1:][-SETTLED_ROWS:])
        found, _ = marked(StepDetector.resumed(day, kept), [*slipped[stop:], *back])
        assert found == [True] * (200 - stop) + [False] * 3


def test_a_slip_seen_late_says_since_when():
    """Too small to be seen in one row: the block of rows after it shows it."""
    day, at = quiet_day()
    found, state = marked(StepDetector(day), [at(k, 0.11, -0.11) for k in range(BLOCK_ROWS)])
    assert found == [False] * (BLOCK_ROWS - 1) + [True]
    assert state.slip is not None
    assert state.slip.since_s == 0.0
    assert state.slip.by_mm == pytest.approx([0.0, 0.11], abs=0.03)


def with_plate(row: RowSummary, closure_mm: float) -> RowSummary:
    return replace(row, closure_mm=np.array([0.0, closure_mm]), closure_sigma_mm=SIGMA_MM)


@pytest.mark.parametrize("known", [10, 300])
def test_a_plate_at_rest_shows_a_slip_that_the_bridge_hides(known: int):
    rng = np.random.default_rng(9)
    _, at = quiet_day(0)
    traffic = rng.standard_t(3, 400)
    rows = [
        with_plate(at(k, 0.3 * (k >= known), traffic[k] - 0.3 * (k >= known)), c)
        for k, c in zip(
            range(known + 5),
            rng.normal(0.0, SIGMA_MM, known + 5) - 0.3 * (np.arange(known + 5) >= known),
            strict=True,
        )
    ]
    found, _ = marked(StepDetector(), rows)
    assert found == [False] * known + [True] * 5


def test_a_plate_at_rest_shows_that_it_was_the_rig():
    """What the bridge alone would say is a slip: the plate does not."""
    day, at = quiet_day()
    rng = np.random.default_rng(10)
    plate = [with_plate(at(k), c) for k, c in enumerate(rng.normal(0.0, SIGMA_MM, 30))]
    moved = [
        with_plate(at(30 + k, 1.0, -1.0), c) for k, c in enumerate(rng.normal(0.0, SIGMA_MM, 12))
    ]
    assert not any(marked(StepDetector(day), [*plate, *moved])[0])


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


@pytest.mark.parametrize("squares", [(2, 0), (0, 2), (-3, 0)])
def test_rendered_boards_that_slipped_are_never_good(usual: Session, squares: tuple[float, float]):
    """Ten rows, four minutes apart; the board slips after six of them.

    The bridge moves by a third of a millimetre from row to row: after six, no less can be told.
    """
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
