"""The axis of a simulated head obeys its speed and acceleration, whatever it is asked and when."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.sim.head_axis import Axis

SPEED, ACCEL = 6.0, 12.0


def test_a_long_move_is_a_trapezoid_of_speed() -> None:
    """Half a second and 1.5 deg up, the same down, 1.5 s along: 12 deg in 2.5 s."""
    axis = Axis((-20.0, 20.0), SPEED, ACCEL)
    axis.go(12.0, 0.0)
    assert [axis.at_deg(t) for t in (0.0, 0.25, 0.5, 1.0, 2.0, 2.5, 9.0)] == pytest.approx(
        [0.0, 0.375, 1.5, 4.5, 10.5, 12.0, 12.0]
    )
    assert axis.rate_deg_s(1.0) == SPEED
    assert axis.moves(2.49)
    assert not axis.moves(2.51)


def test_it_goes_no_further_than_its_end() -> None:
    axis = Axis((-5.0, 5.0), SPEED, ACCEL)
    axis.go(99.0, 0.0)
    assert axis.at_deg(99.0) == 5.0


def test_jammed_it_stands_still() -> None:
    axis = Axis((-5.0, 5.0), SPEED, ACCEL)
    axis.go(5.0, 0.0)
    here = axis.at_deg(0.5)
    axis.jam(0.5)
    axis.go(-5.0, 1.0)
    assert axis.at_deg(9.0) == here
    assert not axis.moves(9.0)


ORDERS = st.lists(
    st.tuples(st.floats(0.0, 3.0), st.one_of(st.none(), st.floats(-20.0, 20.0))),
    min_size=1,
    max_size=8,
)


@given(orders=ORDERS)
def test_speed_and_acceleration_hold_whatever_comes(orders) -> None:
    """Orders at any time, None being a stop: no jump, never too fast, and it ends where sent."""
    axis = Axis((-20.0, 20.0), SPEED, ACCEL)
    now_s, last = 0.0, None
    for pause_s, target in orders:
        times = np.linspace(now_s, now_s + pause_s, 40)
        _require_smooth(axis, times)
        now_s += pause_s
        before = axis.at_deg(now_s), axis.rate_deg_s(now_s)
        axis.stop(now_s) if target is None else axis.go(target, now_s)
        assert (axis.at_deg(now_s), axis.rate_deg_s(now_s)) == pytest.approx(before, abs=1e-6)
        last = target
    _require_smooth(axis, np.linspace(now_s, now_s + 20.0, 400))
    assert not axis.moves(now_s + 20.0)
    assert axis.rate_deg_s(now_s + 20.0) == 0.0
    if last is not None:
        assert axis.at_deg(now_s + 20.0) == last


def _require_smooth(axis: Axis, times: np.ndarray) -> None:
    rates = np.array([axis.rate_deg_s(t) for t in times])
    ways = np.diff([axis.at_deg(t) for t in times])
    spans = np.diff(times)
    assert np.all(np.abs(rates) <= SPEED + 1e-6)
    assert np.all(np.abs(ways) <= SPEED * spans + 1e-6)
    assert np.all(np.abs(np.diff(rates)) <= ACCEL * spans + 1e-6)
