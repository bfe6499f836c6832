"""Weather, animals and covers over many instants: a wrong value is never called good."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from core.results import Flag
from drivers.sim.settings import Scenario
from tests.core.scenes import MINUTE
from tests.core.sessions import Session
from tests.exhaustive import one_of

ROWS = 6
CASES = (
    *("night", "insect_main", "insect_sub", "snow", "glare", "rain"),
    *("cobweb main", "cobweb sub", "cover main", "cover sub"),
)


@pytest.mark.parametrize("case", CASES)
def test_no_wrong_value_is_called_good(usual: Session, case: str):
    kind, _, role = case.partition(" ")
    there = usual.with_world(Scenario(kind, role=role or None))
    start = there.world.settings.start_utc
    for k in range(0, ROWS, one_of(2)):
        row = there.row(start + (30 + 41 * k) * MINUTE)
        if row.measurement.flag is Flag.GOOD:
            assert np.abs(row.error_mm / row.sigma_mm).max() < 5.0


@pytest.mark.parametrize("line_error_um", [1.0, 4.0, 10.0, 60.0][:: one_of(3)])
def test_clear_rows_are_good_on_good_and_poor_prints(
    printed: Callable[[float], Session], line_error_um: float
):
    """Nor is the calibrated board taken for another of the same drawing."""
    count = 12 // one_of(2)
    rows = printed(line_error_um).rows(count, every_min=97.0)
    assert [row.measurement.reasons for row in rows] == [()] * count
