"""The lens models: the same as OpenCV's, with exact derivatives and an exact inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.geometry.lens import Lens
from core.lens_model import LensModel
from tests.core.derivatives import assert_same_derivative, by_differences

COEFFICIENTS = {
    LensModel.RADIAL: [-0.11, 0.03],
    LensModel.FISHEYE: [-0.02, 0.01, -0.003, 0.0004],
    LensModel.BROWN: [-0.11, 0.03, 8e-4, -6e-4, -0.004],
    LensModel.RATIONAL: [0.1, 0.03, 8e-4, -6e-4, -0.004, 0.2, 0.01, 0.003],
}
INTRINSICS = [1040.0, 1036.0, 2.5, 955.0, 610.0]
RNG = np.random.default_rng(5)
POINTS_MM = np.column_stack([RNG.uniform(-45, 45, (40, 2)), RNG.uniform(45, 75, 40)])
every_model = pytest.mark.parametrize("model", list(LensModel))


def lens_of(model: LensModel, gamma_px: float = 2.5) -> Lens:
    """A lens of each model with every coefficient at work."""
    parameters = np.array([*INTRINSICS, *COEFFICIENTS[model]])
    parameters[2] = gamma_px
    return Lens(parameters, model)


@every_model
def test_projects_as_opencv_does(model: LensModel) -> None:
    """Users compare with OpenCV: without skew the pixels are the same."""
    lens = lens_of(model, gamma_px=0.0)
    zero = np.zeros(3)
    project = cv2.fisheye.projectPoints if model is LensModel.FISHEYE else cv2.projectPoints
    fill = [0.0, 0.0] if model is LensModel.RADIAL else []
    coefficients = np.array([*lens.parameters[5:], *fill])
    theirs = project(POINTS_MM[:, None], zero, zero, lens.matrix, coefficients)[0]
    assert lens.project(POINTS_MM) == pytest.approx(theirs.reshape(-1, 2), abs=1e-9)


@every_model
def test_skew_shears_u_by_v(model: LensModel) -> None:
    """Eq. 10: gamma adds gamma y'' to u and nothing to v."""
    lens, straight = lens_of(model), lens_of(model, gamma_px=0.0)
    y = (lens.project(POINTS_MM)[:, 1] - 610.0) / 1036.0
    difference = lens.project(POINTS_MM) - straight.project(POINTS_MM)
    assert difference == pytest.approx(np.column_stack([2.5 * y, 0.0 * y]), abs=1e-10)


def _beside_and_behind() -> np.ndarray:
    """Points up to 100 degrees off the axis."""
    angle, around = np.radians(RNG.uniform(60, 100, 40)), RNG.uniform(0, 6.28, 40)
    sine = np.sin(angle)
    return 50.0 * np.stack([sine * np.cos(around), sine * np.sin(around), np.cos(angle)], axis=1)


@every_model
def test_derivatives_are_exact(model: LensModel) -> None:
    """By the point and by all lens parameters, against central differences."""
    lens = lens_of(model)
    for points in (POINTS_MM, _beside_and_behind() if model is LensModel.FISHEYE else POINTS_MM):
        pixels, by_point, by_lens = lens.project_jacobians(points)
        assert pixels == pytest.approx(lens.project(points), abs=1e-12)
        numeric = by_differences(lambda d: lens.project(points + d), np.full(3, 1e-4))  # noqa: B023
        assert_same_derivative(by_point, numeric)
        numeric = by_differences(
            lambda d: lens.moved(d).project(points),  # noqa: B023
            np.array([1e-2] * 5 + [1e-5] * (lens.size - 5)),
        )
        assert_same_derivative(by_lens, numeric)


@every_model
def test_a_point_on_the_axis_is_no_exception(model: LensModel) -> None:
    """Straight ahead the angle is 0: the image is the principal point, derivatives finite."""
    pixels, by_point, by_lens = lens_of(model).project_jacobians(np.array([[0.0, 0.0, 50.0]]))
    assert pixels[0] == pytest.approx([955.0, 610.0])
    assert by_point[0] == pytest.approx(np.array([[20.8, 0.05, 0.0], [0.0, 20.72, 0.0]]))
    assert np.isfinite(by_lens).all()


@every_model
def test_rays_undo_project(model: LensModel) -> None:
    """Every pixel of the image, corners included, comes back to itself."""
    lens = lens_of(model)
    u, v = np.meshgrid(np.linspace(0, 1919, 25), np.linspace(0, 1199, 17))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = lens.rays(pixels)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    assert lens.project(rays) == pytest.approx(pixels, abs=1e-8)
    assert lens.sees(rays).all()
    assert lens.rays(np.zeros((0, 2))).shape == (0, 3)


def test_a_fisheye_sees_beside_and_behind_itself() -> None:
    """Rays of a 200 degree lens come back, also those that no plane before it would meet."""
    lens, points = lens_of(LensModel.FISHEYE), _beside_and_behind()
    assert (points[:, 2] < 0.0).any()
    assert lens.sees(points).all()
    assert lens.rays(lens.project(points)) == pytest.approx(points / 50.0, abs=1e-9)


def test_a_lens_sees_nothing_twice() -> None:
    """Where a polynomial folds back into the image there is nothing to be seen."""
    barrel = Lens(np.array([500.0, 500.0, 0.0, 320.0, 240.0, -0.3, 0.0]), LensModel.RADIAL)
    edge = 1.0 / np.sqrt(0.9)  # r (1 - 0.3 r^2) is largest here
    points = np.array([[0.95 * edge, 0.0, 1.0], [1.1 * edge, 0.0, 1.0], [0.1, 0.0, -1.0]])
    assert barrel.sees(points).tolist() == [True, False, False]


def test_parameters_of_another_model_are_refused() -> None:
    with pytest.raises(ValueError, match=r"a fisheye lens has 9 parameters, \(10,\) given"):
        Lens(np.zeros(10), LensModel.FISHEYE)
