"""One pair, one verdict: right values when good, reasons when not, and never a crash."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from core.calibration.calibrate import Calibration
from core.images import GreyImage
from core.measurement import measure_pair
from core.quality.verdicts import judge_motion
from core.results import Flag, Measurement, Reason, RigMotion
from drivers.sim.settings import Motion, Optics, Scenario, Sensor
from tests.core.damage import DAMAGES
from tests.core.scenes import MINUTE, reference_utc
from tests.core.sessions import Row, Session
from tests.exhaustive import one_of


@pytest.fixture(scope="module")
def pair(lab: Session) -> tuple[GreyImage, GreyImage]:
    """A good pair of the drift."""
    return lab.pair(lab.world.settings.start_utc + 100 * MINUTE)


def _rows(session: Session, count: int = 2) -> list[Row]:
    return session.rows(count)


def _assert_close(row: Row) -> None:
    """A suspect value is given because it is still right to its sigma."""
    assert np.abs(row.error_mm / row.sigma_mm).max() < 3.5
    assert np.abs(row.error_mm).max() < 0.4


def _assert_consistent(measured: Measurement) -> None:
    """Flag, reasons and values agree with each other, and nothing is NaN."""
    assert all(isinstance(reason, Reason) for reason in measured.reasons)
    assert len(set(measured.reasons)) == len(measured.reasons)
    assert (measured.flag is Flag.GOOD) == (not measured.reasons)
    assert (measured.corrected is not None) == (measured.flag in {Flag.GOOD, Flag.SUSPECT})
    for value in (measured.corrected, measured.raw):
        if value is not None:
            assert np.isfinite(value.mm).all()
            assert np.linalg.eigvalsh(value.covariance_mm2).min() > 0.0
    if measured.motion is not None:
        assert np.isfinite(measured.motion.rotation_rad).all()
        assert np.isfinite(measured.motion.translation_mm).all()
        assert np.linalg.eigvalsh(measured.motion.covariance).min() > 0.0
    if measured.corrected is not None:
        assert measured.raw is not None
        assert measured.motion is not None


# ------------------------------------------------------------------ a good pair


def test_a_good_pair_is_good(lab: Session, pair) -> None:
    """No reason, five discs, nearly all corners, and the figures behind it."""
    measured = measure_pair(*pair, lab.site, lab.calibration, skew_s=0.0005)
    _assert_consistent(measured)
    assert measured.flag is Flag.GOOD
    figures = measured.diagnostics
    assert figures.discs_found == 5
    assert figures.corners_used > 260
    assert figures.main_residual_px is not None
    assert figures.main_residual_px < 0.01
    assert figures.sub_residual_px is not None
    assert figures.sub_residual_px < 0.01
    assert figures.main_contrast_dn == pytest.approx(170.0, abs=20.0)
    assert figures.sub_contrast_dn == pytest.approx(140.0, abs=30.0)
    assert figures.main_blur_px == pytest.approx(0.8, abs=0.15)
    assert figures.sub_blur_px == pytest.approx(0.75, abs=0.15)


def test_the_reference_itself_measures_zero(lab: Session) -> None:
    """The pair of the reference: no motion, no displacement, to some um."""
    reference = lab.views[12]
    assert reference.main is not None
    measured = measure_pair(reference.main, reference.sub, lab.site, lab.calibration)
    assert measured.flag is Flag.GOOD
    assert measured.raw is not None
    assert np.abs(measured.raw.mm).max() < 1e-4
    assert measured.corrected is not None
    assert measured.motion is not None
    assert np.abs(measured.motion.rotation_rad).max() < 3e-5
    assert np.abs(measured.corrected.mm).max() < 0.3


def test_nothing_is_remembered(lab: Session, pair) -> None:
    """The same pair gives the same bits: again, after other pairs, and from two threads."""
    first = measure_pair(*pair, lab.site, lab.calibration)
    other = lab.pair(lab.world.settings.start_utc + 600 * MINUTE)
    measure_pair(*other, lab.site, lab.calibration)
    with ThreadPoolExecutor(2) as pool:
        again = list(
            pool.map(lambda p: measure_pair(*p, lab.site, lab.calibration), [pair, other] * 3)
        )
    for measured in again[::2]:
        assert (measured.flag, measured.reasons) == (first.flag, first.reasons)
        assert measured.diagnostics == first.diagnostics
        for name in ("corrected", "raw"):
            a, b = getattr(measured, name), getattr(first, name)
            assert a.mm.tobytes() == b.mm.tobytes()
            assert a.covariance_mm2.tobytes() == b.covariance_mm2.tobytes()
        assert measured.motion.rotation_rad.tobytes() == first.motion.rotation_rad.tobytes()


def test_images_are_not_written_to(lab: Session, pair) -> None:
    before = [image.pixels.copy() for image in pair]
    assert measure_pair(*pair, lab.site, lab.calibration).flag is Flag.GOOD
    for image, pixels in zip(pair, before, strict=True):
        np.testing.assert_array_equal(image.pixels, pixels)


@pytest.mark.parametrize("bits", [12, 16])
def test_more_bits_measure_the_same(lab: Session, bits) -> None:
    """The same scene through a 12- or 16-bit camera, against the calibration of 8 bits."""
    t_utc = lab.world.settings.start_utc + 100 * MINUTE
    eight = lab.row(t_utc)
    more = lab.with_world(sensor=Sensor(bits=bits)).row(t_utc)
    assert more.measurement.flag is Flag.GOOD
    assert more.error_mm == pytest.approx(eight.error_mm, abs=0.12)
    assert more.sigma_mm == pytest.approx(eight.sigma_mm, rel=0.15)


# ------------------------------------------------------------------ weather and animals


def test_a_rolled_rig_does_not_disturb_the_main_target_where_the_board_is_not_seen(
    lab: Session,
) -> None:
    """The roll turns the discs about one another; only the sub-camera could say by how much."""
    start = lab.world.settings.start_utc
    hours = [start + 60 * k * MINUTE for k in range(1, 25)]
    rolled = max(hours, key=lambda t: abs(lab.world.truth(t).motion.rotation_rad[2]))
    main, _ = lab.pair(rolled)
    measured = measure_pair(main, None, lab.site, lab.calibration)
    assert measured.diagnostics.main_residual_px is not None
    assert measured.diagnostics.main_residual_px > 0.05
    assert measured.reasons == (Reason.SUB_IMAGE_MISSING,)


def test_night_is_bad_and_too_dark(lab: Session) -> None:
    measured = _rows(lab.with_world(Scenario("night")), 1)[0].measurement
    _assert_consistent(measured)
    assert measured.flag is Flag.BAD
    assert measured.reasons[0] is Reason.TOO_DARK
    assert measured.corrected is None
    assert measured.raw is None


def test_dark_at_the_pier_keeps_what_the_main_camera_saw(lab: Session) -> None:
    """The board's lamp fails: no corrected value, but raw is stored."""
    measured = _rows(lab.with_world(Scenario("night", role="sub")), 1)[0].measurement
    _assert_consistent(measured)
    assert measured.flag is Flag.BAD
    assert set(measured.reasons) == {Reason.TOO_DARK, Reason.SUB_TARGET_NOT_FOUND}
    assert measured.raw is not None
    assert measured.motion is None


def test_insect_on_a_disc_is_suspect_and_still_right(lab: Session) -> None:
    for row in _rows(lab.with_world(Scenario("insect_main"))):
        assert row.measurement.flag is Flag.SUSPECT
        assert row.measurement.reasons == (Reason.MAIN_TARGET_PARTLY_HIDDEN,)
        _assert_close(row)


def test_a_disc_covered_in_part_is_suspect_and_not_used(lab: Session, pair) -> None:
    """A twig over a third of a disc: named, and the value is the other four discs'."""
    good = measure_pair(*pair, lab.site, lab.calibration)
    at_px = lab.world.disc_centres_px(lab.world.settings.start_utc + 100 * MINUTE)[1]
    u, v = np.rint(at_px).astype(int)
    pixels = pair[0].pixels.copy()
    pixels[v - 40 : v + 40, u + 9 : u + 40] = 12
    measured = measure_pair(GreyImage(pixels), pair[1], lab.site, lab.calibration)
    assert measured.flag is Flag.SUSPECT
    assert measured.reasons == (Reason.MAIN_TARGET_PARTLY_HIDDEN,)
    assert measured.corrected is not None
    assert good.corrected is not None
    assert measured.corrected.mm == pytest.approx(good.corrected.mm, abs=0.002)


def test_insect_on_the_board_is_suspect_and_still_right(lab: Session) -> None:
    for row in _rows(lab.with_world(Scenario("insect_sub"))):
        assert row.measurement.flag is Flag.SUSPECT
        assert row.measurement.reasons == (Reason.SUB_TARGET_PARTLY_HIDDEN,)
        _assert_close(row)


@pytest.mark.parametrize("kind", ["snow", "glare"])
def test_snow_and_glare_are_suspect_and_still_right(lab: Session, kind) -> None:
    for row in _rows(lab.with_world(Scenario(kind))):
        _assert_consistent(row.measurement)
        assert row.measurement.flag is Flag.SUSPECT
        assert Reason.SUB_TARGET_PARTLY_HIDDEN in row.measurement.reasons
        _assert_close(row)


def test_out_of_focus_is_blurred(lab: Session) -> None:
    soft = lab.with_world(optics=Optics(sub_blur_px=2.0, main_blur_px=2.5))
    measured = _rows(soft, 1)[0].measurement
    assert measured.flag is Flag.SUSPECT
    assert Reason.BLURRED in measured.reasons


def test_little_light_makes_sigma_grow(lab: Session) -> None:
    """A tenth of the light: still measured, and honest about it."""
    dim = Optics(sub_white=0.09, sub_black=0.01, main_white=0.09, main_grey=0.03, main_black=0.01)
    t_utc = lab.world.settings.start_utc + 100 * MINUTE
    row, bright = lab.with_world(optics=dim).row(t_utc), lab.row(t_utc)
    assert row.sigma_mm.min() > 1.3 * bright.sigma_mm.min()
    assert np.abs(row.error_mm / row.sigma_mm).max() < 3.5


# ------------------------------------------------------------------ limits


def test_a_pair_apart_in_time_is_suspect(lab: Session, pair) -> None:
    """Beyond max_skew_ms, either sign; an unknown skew is no reason."""
    for skew_s in (0.021, -0.021):
        measured = measure_pair(*pair, lab.site, lab.calibration, skew_s=skew_s)
        assert measured.reasons == (Reason.NOT_SIMULTANEOUS,)
        assert measured.flag is Flag.SUSPECT
    for skew in (0.019, None):
        assert measure_pair(*pair, lab.site, lab.calibration, skew_s=skew).flag is Flag.GOOD


def test_a_sigma_beyond_the_limit_is_suspect(lab: Session, pair) -> None:
    strict = replace(lab.site, quality=replace(lab.site.quality, max_sigma_mm=0.01))
    measured = measure_pair(*pair, strict, lab.calibration)
    assert measured.reasons == (Reason.SIGMA_TOO_LARGE,)
    assert measured.flag is Flag.SUSPECT


def test_motion_beyond_the_calibration_is_flagged(lab: Session) -> None:
    """Ten millimetres of slip, whether or not the main target is still in view."""
    far = lab.with_world(motion=Motion(drift_mm=14.0))
    measured = _rows(far, 1)[0].measurement
    assert Reason.MOTION_OUT_OF_RANGE in measured.reasons
    assert measured.flag is not Flag.GOOD


def test_each_axis_of_the_rig_has_the_whole_range_for_itself(lab: Session) -> None:
    """Four times what is expected of an axis: a motion along all three may be 1.7 times longer."""
    calibrated, limits = lab.calibration.calibrated, lab.site.quality
    turn_rad = max(calibrated.baseline.max_rotation_rad, 1e-3 * limits.expected_drift_mrad)
    slide_mm = max(calibrated.baseline.max_translation_mm, limits.expected_drift_mm)

    def is_far(turns: list[float], slides: list[float]) -> bool:
        motion = RigMotion(turn_rad * np.array(turns), slide_mm * np.array(slides), np.eye(6))
        return Reason.MOTION_OUT_OF_RANGE in judge_motion(calibrated, motion, lab.site)

    still = [0.0, 0.0, 0.0]
    assert not is_far([3.9, -3.9, 3.9], [-3.9, 3.9, -3.9])
    assert is_far([0.0, -4.1, 0.0], still)
    assert is_far(still, [0.0, 0.0, -4.1])


def test_the_affine_camera_is_refused_where_equation_5_fails(lab: Session, paper: Session) -> None:
    """|dz / d0 (x - x0)| beyond 1 px makes a row suspect, by the paper's method only."""
    off_axis_px = np.nanmax(
        np.abs(paper.calibration.calibrated.reference_discs_px - paper.site.main.centre_px)
    )
    one_px_mm = paper.site.main_target.distance_mm / off_axis_px

    def reasons(session: Session, axial_mm: float) -> list[Reason]:
        motion = RigMotion(np.zeros(3), np.array([0.0, 0.0, axial_mm]), np.eye(6))
        return judge_motion(session.calibration.calibrated, motion, session.site)

    assert Reason.AFFINE_INVALID in reasons(paper, 1.01 * one_px_mm)
    assert Reason.AFFINE_INVALID in reasons(paper, -1.01 * one_px_mm)
    assert Reason.AFFINE_INVALID not in reasons(paper, 0.99 * one_px_mm)
    assert Reason.AFFINE_INVALID not in reasons(lab, 1.01 * one_px_mm)


# ------------------------------------------------------------------ never a crash


@pytest.mark.parametrize(
    ("main", "sub", "flag", "reasons"),
    [
        (None, "good", Flag.MISSING, {Reason.MAIN_IMAGE_MISSING}),
        ("good", None, Flag.MISSING, {Reason.SUB_IMAGE_MISSING}),
        (None, None, Flag.MISSING, {Reason.MAIN_IMAGE_MISSING, Reason.SUB_IMAGE_MISSING}),
        ("black", "good", Flag.BAD, {Reason.TOO_DARK, Reason.MAIN_TARGET_NOT_FOUND}),
        ("good", "black", Flag.BAD, {Reason.TOO_DARK, Reason.SUB_TARGET_NOT_FOUND}),
        ("white", "good", Flag.BAD, {Reason.OVEREXPOSED, Reason.MAIN_TARGET_NOT_FOUND}),
        ("good", "white", Flag.BAD, {Reason.OVEREXPOSED, Reason.SUB_TARGET_NOT_FOUND}),
        ("grey", "good", Flag.BAD, {Reason.MAIN_TARGET_NOT_FOUND}),
        ("noise", "noise", Flag.BAD, {Reason.MAIN_TARGET_NOT_FOUND, Reason.SUB_TARGET_NOT_FOUND}),
        ("small", "good", Flag.BAD, {Reason.MAIN_IMAGE_WRONG_SIZE}),
        ("good", "small", Flag.BAD, {Reason.SUB_IMAGE_WRONG_SIZE}),
        ("colour", "good", Flag.BAD, {Reason.MAIN_IMAGE_UNREADABLE}),
        ("good", "colour", Flag.BAD, {Reason.SUB_IMAGE_UNREADABLE}),
        ("empty", "empty", Flag.BAD, {Reason.MAIN_IMAGE_WRONG_SIZE, Reason.SUB_IMAGE_WRONG_SIZE}),
        (
            "swapped",
            "swapped",
            Flag.BAD,
            {Reason.MAIN_IMAGE_WRONG_SIZE, Reason.SUB_IMAGE_WRONG_SIZE},
        ),
    ],
)
def test_an_image_that_shows_nothing_has_its_reason(lab, pair, main, sub, flag, reasons) -> None:
    """Missing, black, white, noise, wrong size, colour: one row, bad or missing, and why."""
    images: list[GreyImage | None] = []
    for what, good, other in zip((main, sub), pair, pair[::-1], strict=True):
        shape = good.pixels.shape
        choice = {
            None: None,
            "good": good,
            "swapped": other,
            "black": GreyImage(np.zeros(shape, np.uint8)),
            "white": GreyImage(np.full(shape, 255, np.uint8)),
            "grey": GreyImage(np.full(shape, 128, np.uint8)),
            "noise": GreyImage(np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8)),
            "small": GreyImage(np.full((100, 160), 90, np.uint8)),
            "colour": GreyImage(np.full((*shape, 3), 90, np.uint8)),
            "empty": GreyImage(np.zeros((0, 0), np.uint8)),
        }
        images.append(choice[what])
    measured = measure_pair(*images, lab.site, lab.calibration)
    _assert_consistent(measured)
    assert measured.flag is flag
    assert set(measured.reasons) == reasons


def test_images_of_the_other_camera(lab: Session, pair) -> None:
    """Cables swapped at a site whose cameras are alike: bad, not a number."""
    sub = lab.site.sub
    alike = replace(lab.site, main=replace(lab.site.main, width_px=480, height_px=300))
    assert (sub.width_px, sub.height_px) == (480, 300)
    main = GreyImage(np.ascontiguousarray(pair[0].pixels[50:350, 80:560]))
    measured = measure_pair(pair[1], main, alike, lab.calibration)
    _assert_consistent(measured)
    assert measured.flag is Flag.BAD
    assert Reason.SUB_TARGET_NOT_FOUND in measured.reasons


@pytest.mark.parametrize("seed", range(0, 20, one_of(3)))
def test_whatever_happens_to_the_images(lab: Session, pair, seed) -> None:
    """Covered, shaded, noisy, blurred, dim or spotted: consistent, and right if called good."""
    rng = np.random.default_rng(seed)
    images = list(pair)
    for role in (0, 1):
        for _ in range(int(rng.integers(0, 3))):
            images[role] = DAMAGES[int(rng.integers(len(DAMAGES)))](images[role], rng)
    measured = measure_pair(*images, lab.site, lab.calibration)
    _assert_consistent(measured)
    if measured.flag is Flag.GOOD:
        assert measured.corrected is not None
        t_utc = lab.world.settings.start_utc + 100 * MINUTE
        truth = lab.world.truth(t_utc, reference_utc(lab.world.settings))
        sigma = np.sqrt(np.diag(measured.corrected.covariance_mm2))
        assert np.abs((measured.corrected.mm - truth.displacement_mm) / sigma).max() < 4.0


def test_another_sites_calibration_does_not_crash(field: Session, lab: Session, pair) -> None:
    """The wrong calibration activated: flagged or refused, not an exception."""
    wrong = Calibration.from_dict(field.calibration.to_dict())
    _assert_consistent(measure_pair(*pair, lab.site, wrong))
