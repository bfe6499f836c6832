"""The distortion model of a lens is chosen by views that it was not fitted to."""

from __future__ import annotations

import numpy as np
import pytest

from core.geometry.lens import Lens
from core.lens.intrinsics import calibrate_lens_from_corners
from core.lens_model import LensModel
from tests.core.lens.test_lens_from_views import BOARD, SIZE, noisy, true_views
from tests.exhaustive import one_of

LENSES = {
    LensModel.RADIAL: [415.0, 415.0, 0.0, 322.0, 238.0, -0.2, 0.04],
    LensModel.BROWN: [415.0, 415.0, 0.0, 322.0, 238.0, -0.2, 0.04, 4e-3, -3e-3, -0.01],
    LensModel.RATIONAL: [
        *(335.0, 335.0, 0.0, 322.0, 238.0),
        *(0.3, 0.9, 4e-3, -3e-3, 0.0, 0.5, 0.2, 1.5),
    ],
    LensModel.FISHEYE: [205.0, 205.0, 0.0, 322.0, 238.0, 0.01, -0.004, 0.001, -0.0003],
}


@pytest.mark.parametrize("seed", [1, 2][:: one_of(2)])
@pytest.mark.parametrize("model", list(LENSES))
def test_the_true_model_is_chosen(model: LensModel, seed: int) -> None:
    """Neither one with too few coefficients, nor one with some to spare."""
    rng = np.random.default_rng(seed)
    views = noisy(true_views(Lens(np.array(LENSES[model]), model), rng), rng, 0.02)
    found = calibrate_lens_from_corners(views, BOARD, SIZE)
    assert found.lens.model is model, found.choice.sentence
    assert found.choice.held_out_px[model] == pytest.approx(0.021, abs=0.004)
    assert f"distortion: {model}, chosen on held-out views (" in found.choice.sentence


def test_a_model_that_is_named_is_taken() -> None:
    rng = np.random.default_rng(1)
    views = noisy(true_views(Lens(np.array(LENSES[LensModel.RADIAL]), LensModel.RADIAL), rng), rng)
    found = calibrate_lens_from_corners(views, BOARD, SIZE, model=LensModel.RATIONAL)
    assert found.lens.model is LensModel.RATIONAL
    assert found.choice.sentence == "distortion: rational, as configured"


def test_few_views_do_not_choose() -> None:
    rng = np.random.default_rng(1)
    lens = Lens(np.array(LENSES[LensModel.BROWN]))
    found = calibrate_lens_from_corners(noisy(true_views(lens, rng, 5), rng), BOARD, SIZE)
    assert found.choice.sentence == "distortion: brown, not compared with others on only 5 views"
