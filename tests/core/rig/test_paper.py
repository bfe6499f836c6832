"""The paper's nine parameters in its own numerical study (Table 2), and Eq. 5, 7-8 in figures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.geometry.pose import Pose
from core.rig.compensation import affine, affine_error_px
from core.rig.paper import PaperModel, fit_paper

FOCAL_PX = 1920.0 / 200.0 * 10000.0
"""A field of view of 200 mm at 10 m on 1920 pixels."""
T_CM_CS = Pose(
    Rotation.from_euler("xyz", [0.4, 180.6, -0.3], degrees=True).as_matrix(),
    np.array([0.0, 0.0, -80.0]),
)
P_CM_MM = np.array([12.0, -8.0, 10000.0])
P_CS_MM = T_CM_CS.inverse().apply(P_CM_MM[None])[0]
TRUE_B = FOCAL_PX / P_CM_MM[2] * T_CM_CS.R[:2]
DRAWN_B = FOCAL_PX / 10000.0 * np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
DRAWN_P = np.array([0.0, 0.0, -10080.0])


def _table_2(count: int) -> list[Pose]:
    """Rotations about each axis to 1 mrad, translations to 10 mm, then all six at random."""
    rng = np.random.default_rng(2)
    bound = np.array([1e-3] * 3 + [10.0] * 3)
    single = [np.eye(6)[axis] * u for axis in range(6) for u in rng.uniform(-1, 1, count)]
    vectors = bound * np.array([*single, *rng.uniform(-1, 1, (count, 6))])
    return [Pose.from_vectors(v[:3], v[3:]) for v in vectors]


def _image(motions: list[Pose]) -> FloatArray:
    """Shift of the feature's image by a true perspective camera, px."""
    moved = [T_CM_CS.apply(m.apply(P_CS_MM[None]))[0] for m in motions]
    px = FOCAL_PX * np.array([p[:2] / p[2] for p in moved])
    return px - FOCAL_PX * P_CM_MM[:2] / P_CM_MM[2]


def _left_mm(model: PaperModel, motions: list[Pose], shifts_px: FloatArray) -> float:
    """What is left of the false displacement, rms mm."""
    misses = shifts_px - [model.shift(m) for m in motions]
    return float(np.sqrt((misses**2).sum(axis=1).mean())) / (FOCAL_PX / 10000.0)


def test_nine_parameters_are_recovered_exactly() -> None:
    """Eq. 17 as the truth, six degrees of freedom, no noise: every parameter to ten digits."""
    motions = _table_2(20)
    truth = PaperModel(TRUE_B, P_CS_MM, np.eye(9), np.ones(9))
    model = fit_paper(motions, np.array([truth.shift(m) for m in motions]), DRAWN_B, DRAWN_P)
    assert np.abs(model.B - TRUE_B).max() < 1e-8
    assert model.p_mm == pytest.approx(P_CS_MM, rel=1e-7, abs=1e-4)
    assert model.null_directions == 0


def test_table_2_unquantised_and_on_whole_pixels() -> None:
    """With the true camera 3 um of perspective are left; whole pixels of 0.1 mm cost 17 um."""
    motions = _table_2(50)
    exact = _image(motions)
    left = {}
    for pixels in (1, 2, 4, 8):  # 1920, 3840, 7680, 15360 pixels wide
        shifts = np.rint(exact * pixels) / pixels
        left[pixels] = _left_mm(fit_paper(motions, shifts, DRAWN_B, DRAWN_P), motions, exact)
    unquantised = _left_mm(fit_paper(motions, exact, DRAWN_B, DRAWN_P), motions, exact)
    assert unquantised < 0.005
    assert left[1] == max(left.values())
    assert 0.008 < left[1] < 0.04
    assert left[8] == pytest.approx(unquantised, abs=0.001)


def test_pan_and_tilt_alone_leave_a_direction_open() -> None:
    """T = (I - R) c: the fit is perfect on pan-tilt, and wrong by mm on the drift of a year."""
    rng = np.random.default_rng(4)
    centre = np.array([6.0, 118.0, -35.0])
    turns = [Rotation.from_rotvec([*a, 0.0]).as_matrix() for a in rng.uniform(-2e-3, 2e-3, (21, 2))]
    motions = [Pose(R, centre - R @ centre) for R in turns]
    shifts = _image(motions) + rng.normal(0.0, 0.3, (21, 2))
    model = fit_paper(motions, shifts, DRAWN_B, DRAWN_P)
    assert model.null_directions == 1
    assert np.count_nonzero(model.singular_values < 2e-3 * model.singular_values[0]) == 5
    assert _left_mm(model, motions, shifts) < 0.1
    drift = _table_2(20)
    assert _left_mm(model, drift, _image(drift)) > 1.0


def test_affine_camera_is_that_of_the_points() -> None:
    """Eq. 7-8: five points that an affine camera made give its block B~ and its offset back."""
    centres = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
    truth, offset = np.array([[12.4, 0.1], [-0.2, -12.3]]), np.array([960.0, 600.0])
    B, b = affine(centres, centres @ truth.T + offset)
    assert np.abs(B - truth).max() < 1e-10
    assert b == pytest.approx(offset)


def test_affine_error_is_equation_5() -> None:
    """|dz / d0 (x - x0)|: 10 mm towards a target at 10 m cost 0.96 px at the image's edge."""
    assert affine_error_px(10000.0, 10.0, 960.0) == pytest.approx(0.96)
    assert affine_error_px(10000.0, -10.0, 960.0) == pytest.approx(0.96)
    assert affine_error_px(22000.0, 0.0, 960.0) == 0.0
