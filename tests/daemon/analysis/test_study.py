"""Creep that is quick at its beginning is no step, and hides neither a step nor the warmth."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from benchmarks.bridges import BEGIN_S, DAY_S, Bridge, make
from core.analysis.steps import find_steps
from daemon.analysis.record import Channel, Record
from daemon.analysis.study import Asked, Study, study
from daemon.store.ledger.exclusion import ExcludedRows
from tests.exhaustive import one_of

LOADED = datetime.fromtimestamp(BEGIN_S, UTC)


def creeping(tau_days: float, total_mm: float, step_mm: float = 0.0) -> Study:
    """Forty days of rows of ten minutes since loading, half of the creep over within some tau."""
    made = make(Bridge(days=40.0, every=10), seed=21)
    days = (made.times_s - BEGIN_S) / DAY_S
    creep_mm = -0.5 * total_mm * (np.expm1(-days / tau_days) + np.expm1(-days / 60.0))
    y_mm = made.y_mm + creep_mm + step_mm * (days >= 15.0)
    record = Record(
        "main",
        made.times_s,
        np.column_stack([np.zeros(len(y_mm)), y_mm]),
        made.deck_c[:, None],
        (Channel("deck", "degC"),),
        ExcludedRows(0, 0, left_out=True),
    )
    span = LOADED, LOADED + timedelta(days=40.0)
    return study(record, Asked(loaded=LOADED, predict_days=()), span, 600.0)


@pytest.mark.parametrize("tau_days", [0.16, 0.5][:: one_of(2)])
def test_creep_that_begins_quickly_is_no_step(tau_days: float) -> None:
    found = creeping(tau_days, 14.0)
    assert found.steps is not None
    assert found.steps.steps == ()
    assert found.thermal is not None
    (deck,) = found.thermal.responses
    assert deck.mm_per_unit.value == pytest.approx(0.25, abs=0.002)
    assert deck.mm_per_unit.sigma < 0.001  # creep is not left for weather to explain


def test_a_step_beside_quick_creep_is_one() -> None:
    found = creeping(0.3, -9.0, step_mm=0.3)
    assert found.steps is not None
    (step,) = found.steps.steps
    assert step.mm.low <= 0.3 <= step.mm.high
    assert abs(step.time_s - BEGIN_S - 15.0 * DAY_S) <= 7200.0


@pytest.mark.parametrize("seed", range(0, 4, one_of(2)))
def test_a_step_soon_after_loading_is_found_once(seed: int) -> None:
    """Creep, fitted in many columns, follows a step there nearly; what is left is rounding."""
    rng = np.random.default_rng(seed)
    hours = np.arange(90 * 24)
    rates = 0.1 * 2.0 ** np.arange(11)
    settling = -np.expm1(-hours[:, None] / 24.0 / rates)
    values_mm = settling @ rng.normal(size=11) * 20.0 + 0.02 * rng.normal(size=len(hours))
    times_s = BEGIN_S + 3600.0 * hours
    (step,) = find_steps(times_s, values_mm + 2.0 * (hours >= 57), settling).steps
    assert step.mm.value == pytest.approx(2.0, abs=0.1)
    assert abs(step.time_s - BEGIN_S - 57.0 * 3600.0) <= 3600.0
