"""Whether sigma is true: errors over many simulated sites, from image noise through calibration.

The rows of one site share the error of its calibration, so only many sites tell. Points instead of
images keep that fast; `python -m benchmarks.sites` does the same at full size, or with images.
"""

from __future__ import annotations

import pytest

from benchmarks.made_sites import Case, make_numbers, quiet_pairs
from benchmarks.sites import Figures, figures, measured
from tests.exhaustive import one_of

SITES = 10
QUARTER = 4.0
"""Of the pixels along each side."""


@pytest.fixture(scope="module", params=["lab", "field"][:: one_of(2)])
def pooled(request: pytest.FixtureRequest) -> tuple[Figures, Figures]:
    """Rows of sites of other lenses, boards and print errors of 10 um; and rows without noise."""
    case = Case(request.param, print_um=10.0, bow_um=60.0, shrink=QUARTER)
    rows, quiet = [], []
    for seed in range(1, SITES + 1, one_of(2)):
        made = make_numbers(case, seed)
        rows += measured(made, made.pairs, quiet=False)
        quiet += measured(made, quiet_pairs(made, case), quiet=True)
    return figures(rows), figures(quiet)


def test_two_thirds_of_the_errors_are_within_one_sigma(pooled: tuple[Figures, Figures]) -> None:
    """Pooled over sites, sigma is what it says."""
    rows, _ = pooled
    assert 0.60 < rows.within_1 < 0.76
    assert rows.within_2 > 0.92  # of 240 values, 24 to a calibration; of 40 sites 0.95
    assert 0.88 < rows.whitened_rms < 1.15


def test_the_calibrations_own_part_is_true(pooled: tuple[Figures, Figures]) -> None:
    """Rows without any noise of their own: what is left is the calibration's error, as stated."""
    _, quiet = pooled
    assert 0.65 < quiet.whitened_rms < 1.25
    assert quiet.within_2 > 0.90
