"""The lens model: the same as OpenCV's, with exact derivatives and an exact inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.lens import Lens
from tests.core.derivatives import assert_same_derivative, by_differences

LENS = Lens(np.array([1040.0, 1036.0, 2.5, 955.0, 610.0, -0.11, 0.03, 8e-4, -6e-4, -0.004]))
RNG = np.random.default_rng(5)
POINTS_MM = np.column_stack([RNG.uniform(-45, 45, (40, 2)), RNG.uniform(45, 75, 40)])


def test_projects_as_opencv_does() -> None:
    """Users compare with OpenCV: without skew the pixels are the same."""
    parameters = LENS.parameters.copy()
    parameters[2] = 0.0
    lens = Lens(parameters)
    theirs = cv2.projectPoints(POINTS_MM, np.zeros(3), np.zeros(3), lens.matrix, parameters[5:])[0]
    assert lens.project(POINTS_MM) == pytest.approx(theirs.reshape(-1, 2), abs=1e-9)


def test_skew_shears_u_by_v() -> None:
    """Eq. 10: gamma adds gamma y'' to u and nothing to v."""
    no_skew = LENS.parameters.copy()
    no_skew[2] = 0.0
    y = (LENS.project(POINTS_MM)[:, 1] - 610.0) / 1036.0
    difference = LENS.project(POINTS_MM) - Lens(no_skew).project(POINTS_MM)
    assert difference == pytest.approx(np.column_stack([2.5 * y, 0.0 * y]), abs=1e-10)


def test_derivatives_are_exact() -> None:
    """By the point and by all ten lens parameters, against central differences."""
    pixels, by_point, by_lens = LENS.project_jacobians(POINTS_MM)
    assert pixels == pytest.approx(LENS.project(POINTS_MM), abs=1e-12)
    numeric = by_differences(lambda d: LENS.project(POINTS_MM + d), np.full(3, 1e-4))
    assert_same_derivative(by_point, numeric)
    numeric = by_differences(
        lambda d: Lens(LENS.parameters + d).project(POINTS_MM),
        np.array([1e-2] * 5 + [1e-5] * 5),
    )
    assert_same_derivative(by_lens, numeric)


def test_normalise_undoes_project() -> None:
    """Every pixel of the image, corners included, comes back to itself."""
    u, v = np.meshgrid(np.linspace(0, 1919, 25), np.linspace(0, 1199, 17))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = LENS.normalise(pixels)
    assert LENS.project(np.column_stack([rays, np.ones(len(rays))])) == pytest.approx(
        pixels, abs=1e-8
    )
    assert LENS.normalise(np.zeros((0, 2))).shape == (0, 2)
