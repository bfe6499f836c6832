"""What a reference's noise does to rows and to links: no more and no less than is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.datum_covariance import WAYS, common_mm2, draw, squares

TRIALS = 60


@pytest.mark.parametrize("calibrations", [2, 4], ids=["one after the first", "three"])
def test_a_row_in_the_records_zero_errs_as_its_sigma_says(calibrations: int) -> None:
    """Without a fixed plate row and datum have most of their errors in common."""
    rng = np.random.default_rng(7)
    drawn = [draw(WAYS[0], calibrations, rng) for _ in range(TRIALS)]
    found = squares(drawn)
    assert found["sum"] == pytest.approx(1.0, abs=4.0 / np.sqrt(TRIALS))
    assert found["as if independent"] < 0.75 * found["sum"]
    predicted, seen = common_mm2(drawn)
    spread = np.std([one.row_mm * one.datum_mm for one in drawn], axis=0)
    assert (np.abs(predicted - seen) < 4.0 * spread / np.sqrt(TRIALS)).all()
    assert (predicted < 0.0).all()


def test_a_fixed_plate_seen_by_both_is_common_to_both() -> None:
    rng = np.random.default_rng(8)
    drawn = [draw(WAYS[1], 2, rng) for _ in range(TRIALS)]
    predicted, seen = common_mm2(drawn)
    spread = np.std([one.row_mm * one.datum_mm for one in drawn], axis=0)
    assert (np.abs(predicted - seen) < 4.0 * spread / np.sqrt(TRIALS)).all()
    assert squares(drawn)["sum"] == pytest.approx(1.0, abs=4.0 / np.sqrt(TRIALS))
