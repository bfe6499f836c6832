"""Calibration against the truth: in mm after correction, in angles, in the board's print.

The images have a sixteenth of a real pair's pixels, so errors are four to five times larger.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.arrays import FloatArray
from core.calibration.calibrate import Calibration, calibrate
from core.errors import CalibrationError
from core.lens_model import LensModel
from core.measurement import measure_pair
from core.results import Flag
from core.rig.rigid import Rig
from tests.core.scenes import MINUTE
from tests.core.sessions import Row, Session


@pytest.fixture(scope="module")
def lab_rows(lab: Session) -> list[Row]:
    return lab.rows(12)


@pytest.fixture(scope="module")
def field_rows(field: Session) -> list[Row]:
    return field.rows(12)


def _rms(values: list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# ------------------------------------------------------------------ in mm


def test_laboratory_in_mm(lab: Session, lab_rows: list[Row]) -> None:
    """At 11 m a milliradian of drift is corrected to 0.15 mm rms, from 5 mm."""
    assert lab.report.passed
    assert all(row.measurement.flag is Flag.GOOD for row in lab_rows)
    assert _rms([row.raw_error_mm for row in lab_rows]) > 3.0
    assert _rms([row.error_mm for row in lab_rows]) < 0.15
    assert np.abs([row.error_mm for row in lab_rows]).max() < 0.3


def test_field_in_mm(field: Session, field_rows: list[Row]) -> None:
    """At 22 m twice that."""
    assert field.report.passed
    assert np.abs([row.raw_error_mm for row in field_rows]).max() > 10.0
    assert _rms([row.error_mm for row in field_rows]) < 0.3
    assert np.abs([row.error_mm for row in field_rows]).max() < 0.6


def test_raw_is_the_true_and_the_false_displacement(lab_rows: list[Row]) -> None:
    """What the main camera alone shows: Eq. 15, to the perspective's part in a thousand."""
    for row in lab_rows:
        assert row.measurement.raw is not None
        together = row.truth.displacement_mm + row.truth.false_mm
        assert row.measurement.raw.mm == pytest.approx(together, abs=0.05)


def test_motion_is_the_rigs(lab_rows: list[Row]) -> None:
    """Eq. 12: rotation to some 10 urad, translation to some um, within its covariance."""
    misses = []
    for row in lab_rows:
        motion = row.measurement.motion
        assert motion is not None
        miss = np.concatenate([motion.rotation_rad, motion.translation_mm])
        miss -= row.truth.motion.vector
        misses.append(miss)
    assert np.abs(np.array(misses)[:, :3]).max() < 6e-5
    assert np.abs(np.array(misses)[:, 3:]).max() < 6e-3


def test_sigma_is_honest(lab_rows: list[Row], field_rows: list[Row]) -> None:
    """Over both sites the errors are what the rows' own sigmas say."""
    z = np.array([row.error_mm / row.sigma_mm for row in (*lab_rows, *field_rows)])
    assert 0.5 < _rms(list(z)) < 2.0
    assert np.mean(np.abs(z) < 1.0) > 0.5
    assert np.abs(z).max() < 4.0


def test_the_calibrations_part_of_sigma_grows_with_the_motion(
    lab: Session, lab_rows: list[Row]
) -> None:
    """At the reference the calibration cancels; the further away, the more of it comes in."""
    still = lab.row(lab.world.settings.start_utc)
    assert np.linalg.norm(still.truth.motion.vector) < 1e-9
    assert max(_shared_mm(row) for row in lab_rows) > 1.1 * _shared_mm(still)
    assert min(row.sigma_mm.max() for row in lab_rows) > 0.9 * still.sigma_mm.max()


def _shared_mm(row: Row) -> float:
    assert row.measurement.corrected is not None
    shared = row.measurement.corrected.shared_mm2
    assert shared is not None
    return float(np.sqrt(np.diag(shared).max()))


# ------------------------------------------------------------------ in what was built


@pytest.mark.parametrize("name", ["lab", "field"])
def test_rig_and_lens_are_found(name, request) -> None:
    """Angles between the cameras, scale and lens as built, within their sigmas."""
    made: Session = request.getfixturevalue(name)
    calibrated, truth = made.calibration.calibrated, made.world.geometry
    rig_sigma = np.array(made.report.figures["rig_sigma"])
    lens_sigma = np.array(made.report.figures["lens_sigma"])
    assert isinstance(calibrated.model, Rig)
    turn_rad = calibrated.model.T_CM_CS.compose(truth.T_CM_CS.inverse()).rotation_rad
    assert np.abs(turn_rad / rig_sigma[:3]).max() < 3.0
    assert np.degrees(rig_sigma[:3]).max() < 1.0
    # One angle is far better known than drawn: it turns the false displacement itself.
    assert np.degrees(rig_sigma[2]) < 0.5
    # The scale is measured on the target to a part in a thousand, the depth is the survey's.
    px_per_mm = truth.main.fx_px / truth.T_CM_WM.t_mm[2]
    assert abs(np.log(calibrated.model.scale_px_per_mm / px_per_mm)) < 3.0 * rig_sigma[7]
    assert rig_sigma[7] < 2.5e-3
    assert abs(np.log(calibrated.model.depth_mm / truth.T_CM_WM.t_mm[2])) < 3.0 * rig_sigma[6]
    lens = np.array([truth.sub.fx_px, truth.sub.fy_px, truth.sub.cx_px, truth.sub.cy_px])
    assert (
        np.abs((calibrated.lens.parameters[[0, 1, 3, 4]] - lens) / lens_sigma[[0, 1, 3, 4]]).max()
        < 4.0
    )
    assert calibrated.lens.parameters[0] == pytest.approx(truth.sub.fx_px, rel=2e-4)


def test_the_printed_board_is_found(lab: Session) -> None:
    """Print errors of 4 um and a bow of 20 um come out to a few tenths of a um."""
    true = lab.world.geometry.board.corners_mm()[1:-1, 1:-1].reshape(-1, 3)
    calibrated = lab.calibration.calibrated
    nominal_um = 1e3 * _departure_mm(calibrated.board.corners_mm, true)
    found_um = 1e3 * _departure_mm(calibrated.corners_mm, true)
    assert np.sqrt((nominal_um[:, :2] ** 2).mean()) > 2.5
    assert np.abs(nominal_um[:, 2]).max() > 8.0
    assert np.sqrt((found_um[:, :2] ** 2).mean()) < 0.5
    assert np.abs(found_um[:, 2]).max() < 1.0
    assert lab.report.figures["board_bow_mm"] == pytest.approx(np.ptp(true[:, 2]), abs=0.002)


def _departure_mm(points: FloatArray, true: FloatArray) -> FloatArray:
    """(n, 3) what is left after the best rigid motion and scale (no image can tell those)."""
    a, b = points - points.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(a.T @ b)
    scale = s.sum() / (a**2).sum()
    return b - scale * a @ (u @ vt)


def test_report_tells_what_to_expect(lab: Session) -> None:
    """A sentence with the verdict first, an expected error per motion, a held-out check."""
    figures = lab.report.figures
    assert lab.report.lines[0] == "calibration passed"
    assert set(figures["expected_error_mm"]) == {
        f"{kind} {axis}" for kind in ("rotation about", "translation along") for axis in "xyz"
    }
    assert figures["sub_rms_px"] < 0.006
    assert figures["main_rms_px"] < 0.01
    assert len(figures["held_out_mm"]) == 3
    assert _rms(figures["held_out_mm"]) < 0.3
    json.dumps(figures, allow_nan=False)


# ------------------------------------------------------------------ the paper's method


def test_paper_is_reported_as_not_determined(paper: Session) -> None:
    """Pan and tilt leave a direction open (scale against lever): not passed, and said so."""
    assert not paper.report.passed
    assert "not determined by the motions" in paper.report.lines[0]
    values = np.array(paper.report.figures["singular_values"])
    assert values[-1] < 2e-4 * values[0]
    assert np.count_nonzero(values < 0.02 * values[0]) >= 4


def test_paper_holds_for_motions_like_its_own(paper: Session) -> None:
    """Other positions of the head, target at rest: tens of mm corrected to 1 mm."""
    world, start = paper.world, paper.world.settings.start_utc - 60 * MINUTE
    errors, raw = [], []
    for pan_deg, tilt_deg in [(0.08, 0.03), (-0.09, 0.04), (0.03, -0.05)]:
        world.turn_head(pan_deg, tilt_deg)
        row = paper.row(start)
        errors.append(row.error_mm)
        raw.append(row.raw_error_mm)
    world.turn_head(0.0, 0.0)
    assert np.abs(raw).max() > 10.0
    assert np.abs(errors).max() < 1.0


def test_paper_is_wrong_on_drift_and_its_rows_are_suspect(
    paper: Session, lab_rows: list[Row]
) -> None:
    """The same views, the same pairs: millimetres where the rigid method leaves tenths."""
    rows = paper.rows(3)
    assert all(row.measurement.flag is Flag.SUSPECT for row in rows)
    assert _rms([r.error_mm for r in rows]) > 10.0 * _rms([r.error_mm for r in lab_rows[:3]])


@pytest.mark.parametrize(("off_deg", "passed"), [(4.0, True), (6.0, False)])
def test_a_rig_far_from_its_drawing_does_not_pass(
    usual: Session, off_deg: float, passed: bool
) -> None:
    """Drawn to a degree; three angles are 4 degrees off together now and then, 6 never."""
    rig = usual.calibration.calibrated.model
    assert isinstance(rig, Rig)
    turn = Rotation.from_rotvec(np.array([0.0, 0.0, off_deg]), degrees=True)
    drawn = (turn * Rotation.from_matrix(rig.T_CM_CS.R)).as_euler("xyz", degrees=True)
    site = replace(usual.site, rig=replace(usual.site.rig, rotation_main_sub_deg=drawn))
    _, report = calibrate(usual.views, site)
    assert report.passed is passed
    assert any("turned against one another" in line for line in report.lines[:1]) is not passed


# ------------------------------------------------------------------ the same again


def test_round_trip_through_json_measures_the_same(lab: Session, paper: Session) -> None:
    """A calibration read back from the database gives identical rows."""
    pair = lab.pair(lab.world.settings.start_utc + 100 * MINUTE)
    for made in (lab, paper):
        text = json.dumps(made.calibration.to_dict(), allow_nan=False)
        again = Calibration.from_dict(json.loads(text))
        assert again.to_dict() == made.calibration.to_dict()
        _assert_identical(
            measure_pair(*pair, made.site, again),
            measure_pair(*pair, made.site, made.calibration),
        )


def _assert_identical(a, b) -> None:
    assert (a.flag, a.reasons, a.diagnostics) == (b.flag, b.reasons, b.diagnostics)
    assert np.array_equal(a.corrected.mm, b.corrected.mm)
    assert np.array_equal(a.corrected.covariance_mm2, b.corrected.covariance_mm2)
    assert np.array_equal(a.motion.rotation_rad, b.motion.rotation_rad)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.pop("setup"),
        lambda d: d.update(format=99),
        lambda d: d.update(method="magic"),
        lambda d: d["setup"].pop("lens"),
        lambda d: d["setup"]["model"].update(kind="bendy"),
        lambda d: d["setup"].update(levels={}),
    ],
    ids=["no setup", "format", "method", "no lens", "model", "no levels"],
)
def test_a_damaged_calibration_is_refused(quick: Session, spoil) -> None:
    data = json.loads(json.dumps(quick.calibration.to_dict()))
    spoil(data)
    with pytest.raises(CalibrationError, match="calibration"):
        Calibration.from_dict(data)


def test_order_of_the_views_does_not_matter(quick: Session) -> None:
    order = np.random.default_rng(2).permutation(len(quick.views))
    calibration, _ = calibrate([quick.views[k] for k in order], quick.site)
    pair = quick.pair(quick.world.settings.start_utc + 100 * MINUTE)
    first = measure_pair(*pair, quick.site, quick.calibration)
    second = measure_pair(*pair, quick.site, calibration)
    assert first.corrected is not None
    assert second.corrected is not None
    # The fit stops once a step no longer matters beside the sigma; where, the order may decide.
    sigma_mm = np.sqrt(np.diag(first.corrected.covariance_mm2))
    assert np.all(np.abs(second.corrected.mm - first.corrected.mm) < 1e-3 * sigma_mm)
    assert second.corrected.covariance_mm2 == pytest.approx(
        first.corrected.covariance_mm2, rel=1e-4
    )


def test_skew_is_found_to_be_none(quick: Session) -> None:
    """The gamma of Eq. 10 may vary where asked for; these lenses have none."""
    assert quick.calibration.calibrated.lens.parameters[2] == pytest.approx(0.0, abs=1e-6)
    calibration, report = calibrate(quick.views, quick.site, skew=True)
    gamma_px = calibration.calibrated.lens.parameters[2]
    assert 0.0 < abs(gamma_px) < 0.2
    assert abs(gamma_px) < 4.0 * report.figures["lens_sigma"][2]


def test_the_lens_model_is_chosen_and_said(lab: Session) -> None:
    """The simulated lens is Brown's: less predicts held-out views far worse, more no better."""
    off_px = lab.report.figures["lens_held_out_px"]
    assert lab.calibration.calibrated.lens.model is LensModel.BROWN
    assert off_px["radial"] > 2.0 * off_px["brown"]
    assert off_px["rational"] == pytest.approx(off_px["brown"], rel=0.1)
    start = "distortion: brown, chosen on held-out views (radial "
    assert sum(line.startswith(start) for line in lab.report.lines) == 1


@pytest.mark.parametrize(("model", "near_mm"), [("rational", 0.03), ("fisheye", 0.5)])
def test_a_site_may_name_its_lens_model(quick: Session, model: str, near_mm: float) -> None:
    """Rows by such a calibration, stored and read again, are what they are by the other's."""
    site = replace(quick.site, lens_model=LensModel(model))
    calibration, report = calibrate(quick.views, site)
    assert f"distortion: {model}, as configured" in report.lines
    read = Calibration.from_dict(json.loads(json.dumps(calibration.to_dict())))
    assert read.calibrated.lens.model is LensModel(model)
    pair = quick.pair(quick.world.settings.start_utc + 100 * MINUTE)
    row, usual = measure_pair(*pair, site, read), measure_pair(*pair, site, quick.calibration)
    assert row.corrected is not None
    assert usual.corrected is not None
    assert row.corrected.mm == pytest.approx(usual.corrected.mm, abs=near_mm)
