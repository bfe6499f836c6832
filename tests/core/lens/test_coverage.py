"""Whether sigma is true: errors over many simulated sites, from image noise through calibration.

The rows of one site share the error of its calibration, so only many sites tell. Points instead of
images keep that fast; `python -m benchmarks.sites` does the same at full size, or with images.
"""

from __future__ import annotations

import pytest

from benchmarks.sites import Case, Kind, figures, run_numbers

SITES = 10
QUARTER = 4.0
"""Of the pixels along each side."""


def _pooled(case: Case):
    return figures([row for seed in range(1, SITES + 1) for row in run_numbers(case, seed).rows])


@pytest.mark.parametrize("kind", ["lab", "field"])
def test_two_thirds_of_the_errors_are_within_one_sigma(kind: Kind) -> None:
    """Other lenses, boards and print errors of 10 um: pooled over sites, sigma is what it says."""
    pooled = _pooled(Case(kind, print_um=10.0, bow_um=60.0, shrink=QUARTER))
    assert 0.60 < pooled.within_1 < 0.76
    assert pooled.within_2 > 0.93
    assert 0.88 < pooled.whitened_rms < 1.15


@pytest.mark.parametrize("kind", ["lab", "field"])
def test_the_calibrations_own_part_is_true(kind: Kind) -> None:
    """Rows without any noise of their own: what is left is the calibration's error, as stated."""
    pooled = _pooled(Case(kind, shrink=QUARTER, quiet_rows=True))
    assert 0.65 < pooled.whitened_rms < 1.25
    assert pooled.within_2 > 0.90
