"""What once went wrong, or nearly: covers at the border, odd images, views that do not belong."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from core.calibration.calibrate import calibrate
from core.checkerboard.corners import locate_board
from core.checkerboard.resection import resect
from core.discs.disc_finder import find_discs
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.measurement import measure_pair
from core.results import Flag
from tests.core.boards import AS_CORE, BoardScene
from tests.core.damage import blurred, covered, dimmed, noisy, shaded, spotted
from tests.core.scenes import CENTRES_MM, MINUTE, reference_utc
from tests.core.targets import PX_PER_MM, TargetScene
from tests.drivers.sim.rigs import site


def _errors(usual, calibration):
    out = []
    for k in range(1, 6):
        t = usual.world.settings.start_utc + 60 * k * MINUTE
        m = measure_pair(*usual.pair(t), usual.site, calibration)
        truth = usual.world.truth(t, reference_utc(usual.world.settings))
        if m.corrected is not None:
            e = m.corrected.mm - truth.displacement_mm
            out.append((int(m.flag), e, e / np.sqrt(np.diag(m.corrected.covariance_mm2))))
    return out


@pytest.mark.parametrize("light", [2.0, 2.5, 3.0])
def test_overexposed_target_is_found(light):
    scene = TargetScene(light=light)
    discs = find_discs(scene.image(), scene.target, PX_PER_MM)
    assert discs.found.all()


def _stretch(image, f):
    h, w = image.pixels.shape
    m = np.array([[f, 0.0, (1 - f) * w / 2], [0.0, 1.0, 0.0]])
    return GreyImage(cv2.warpAffine(image.pixels, m, (w, h), borderMode=cv2.BORDER_REPLICATE))


def _damage_seed(pair, k, kinds):
    rng = np.random.default_rng(k)
    images = list(pair)
    which = rng.integers(3)
    for r in (0, 1):
        if which in (2, r):
            for _ in range(rng.integers(1, 3)):
                images[r] = kinds[rng.integers(len(kinds))](images[r], rng)
    return images


@pytest.mark.parametrize("seed", [5453, 5459, 5090, 5283, 5345, 9048, 9155])
def test_odd_images_do_not_raise(usual, seed):
    pair = usual.pair(usual.world.settings.start_utc + 100 * MINUTE)
    images = _damage_seed(pair, seed, (covered, shaded, noisy, blurred, dimmed, spotted))
    m = measure_pair(*images, usual.site, usual.calibration)
    if m.corrected is not None:  # a "suspect" value of metres helps nobody: withhold it
        assert np.abs(m.corrected.mm).max() < 500.0


@pytest.mark.parametrize("how", ["mirrored", "upside down", "torn"])
def test_mirrored_or_torn_board_is_refused(usual, how):
    pair = usual.pair(usual.world.settings.start_utc + 100 * MINUTE)
    p = pair[1].pixels
    q = {
        "mirrored": p[:, ::-1],
        "upside down": p[::-1],
        "torn": np.vstack([p[:150], np.roll(p[150:], 57, 1)]),
    }[how]
    m = measure_pair(pair[0], GreyImage(np.ascontiguousarray(q)), usual.site, usual.calibration)
    assert m.flag is Flag.BAD


def test_many_bright_spots_are_no_target():
    """A perforated plate: a thousand round spots, none a target."""
    image = np.full((1200, 1920), 20, np.uint8)
    for y in range(20, 1200, 48):
        for x in range(20, 1920, 48):
            cv2.circle(image, (x, y), 12, 200, -1, cv2.LINE_AA)
    with pytest.raises(TargetNotFoundError):
        find_discs(GreyImage(image), site(1).main_target, site(1).nominal_px_per_mm)


def test_sloppy_layout_does_not_win_over_an_exact_one():
    """Two discs hidden, twelve other spots: four that nearly fit must not beat three that do."""
    rng = np.random.default_rng(2)
    spots = []
    while len(spots) < 12:
        x, y, r = rng.uniform(-27, 27), rng.uniform(-23, 23), rng.uniform(1.5, 6)
        if min(np.hypot(*(CENTRES_MM - [x, y]).T)) < r + 5.5 or any(
            np.hypot(x - a, y - b) < r + c + 1 for a, b, c in spots
        ):
            continue
        spots.append((x, y, r))
    scene = TargetScene(spots_mm=tuple(spots), hidden=(1, 3), roll_deg=10)
    try:
        discs = find_discs(scene.image(), scene.target, PX_PER_MM)
    except TargetNotFoundError:
        return
    assert np.nanmax(np.abs(discs.points_px - scene.centres_px)) < 1.0


@pytest.mark.parametrize("factor", [1.02, 1.1])
def test_grossly_wrong_corners_of_one_lens_view_is_rejected(usual, factor):
    """Also where most of its corners fade out, so that the rest fits perfectly."""
    views = list(usual.views)
    views[2] = replace(views[2], sub=_stretch(views[2].sub, factor))
    _, report = calibrate(views, usual.site)
    assert [r["view"] for r in report.figures["rejected"]] == ["lens 2"]


def test_a_target_that_moved_in_one_rig_view_is_noticed(usual):
    """The bridge moved by 1 mm (6 px) while one rig view was taken."""
    views = list(usual.views)
    main = views[10].main
    moved = cv2.warpAffine(
        main.pixels, np.float32([[1, 0, 6], [0, 1, 6]]), (640, 400), borderMode=cv2.BORDER_REPLICATE
    )
    views[10] = replace(views[10], main=GreyImage(moved))
    _, report = calibrate(views, usual.site)
    assert not report.passed or report.figures["rejected"]


@pytest.fixture(scope="module")
def no_lens_views(usual):
    """What comes of the rig views alone."""
    return calibrate(usual.views[8:], usual.site)


def test_without_lens_views_it_does_not_pass_or_is_right(usual, no_lens_views):
    """Pan and tilt alone do not determine the lens."""
    calibration, report = no_lens_views
    rows = _errors(usual, calibration)
    assert not report.passed or max(np.abs(z).max() for _, _, z in rows) < 3.0


def test_calibration_without_lens_views_is_repeatable(usual, no_lens_views):
    a, b = (
        calibration.calibrated.lens.parameters
        for calibration, _ in (no_lens_views, calibrate(usual.views[8:], usual.site))
    )
    assert a == pytest.approx(b, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("rows", [1, 2, 3])
@pytest.mark.parametrize("minute", [60, 100, 300])
def test_hidden_border_rows_do_not_shift_the_board(usual, rows, minute):
    """Snow on the lowest rows looks like the border of the board, a row or more too high."""
    t = usual.world.settings.start_utc + minute * MINUTE
    main, sub = usual.pair(t)
    px = usual.world.board_corners_px(t)
    pixels = sub.pixels.copy()
    pixels[int(px[-1 - rows, :, 1].min() - 6) :] = 200
    m = measure_pair(main, GreyImage(pixels), usual.site, usual.calibration)
    truth = usual.world.truth(t, reference_utc(usual.world.settings))
    assert m.corrected is not None, m.reasons
    assert m.flag is Flag.SUSPECT
    sigma = np.sqrt(np.diag(m.corrected.covariance_mm2))
    assert np.abs((m.corrected.mm - truth.displacement_mm) / sigma).max() < 4.0


def test_hidden_columns_of_a_board_cut_off_at_the_other_side():
    """Left two columns covered, right border outside the image: right, or said to be uncertain."""
    scene = BoardScene().moved(4.0, 0.0)
    pixels = scene.image().pixels.copy()
    pixels[:, : int(scene.corners_px.reshape(14, 21, 2)[:, 1, 0].max() + 8)] = 120
    nominal = scene.board.corners_mm
    seen = locate_board(GreyImage(pixels), AS_CORE, scene.board, nominal, scene.pose)
    shift = resect(AS_CORE, nominal, seen.view).pose.compose(scene.pose.inverse()).t_mm
    assert not seen.unambiguous or np.abs(shift).max() < 0.1


def test_raw_of_a_disturbed_main_target_has_its_reason(usual):
    """Also when the board was not seen; here four squares of a board might pass for discs."""
    pair = usual.pair(usual.world.settings.start_utc + 100 * MINUTE)
    alike = replace(usual.site, main=replace(usual.site.main, width_px=480, height_px=300))
    black = GreyImage(np.zeros_like(pair[1].pixels))
    m = measure_pair(pair[1], black, alike, usual.calibration)
    assert m.raw is None or any(r.value.startswith("main_target") for r in m.reasons)
