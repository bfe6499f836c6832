"""A reference that is the mean of several images, in 16 bits, beside views of 8 bits."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from core.calibration.calibrate import ViewRole, calibrate
from core.errors import ImageError
from core.images import GreyImage, mean_image
from core.measurement import measure_pair
from core.results import Flag, Reason
from tests.core.scenes import MINUTE, grey, reference_utc
from tests.core.sessions import Session


def grey_image(*values: int, bits: int = 8) -> GreyImage:
    return GreyImage(np.array([values], np.uint8 if bits == 8 else np.uint16), bits)


def test_the_mean_fills_sixteen_bits_and_keeps_what_is_saturated() -> None:
    """A pixel saturated in one image alone is not known to be a little darker than white."""
    mean = mean_image([grey_image(0, 10, 255, 254), grey_image(0, 11, 255, 255)])
    assert (mean.bits, mean.saturation_dn) == (16, 65535.0)
    assert mean.pixels.dtype == np.uint16
    np.testing.assert_array_equal(mean.pixels, [[0, round(10.5 * 257), 65535, 65535]])
    almost = mean_image([grey_image(4094, bits=12), grey_image(4094, bits=12)])
    assert 65500 < almost.pixels[0, 0] < 65535


def test_images_of_another_size_or_depth_have_no_mean() -> None:
    with pytest.raises(ImageError, match="2 images of 2 sizes or depths"):
        mean_image([grey_image(1, 2), grey_image(1, 2, 3)])
    with pytest.raises(ImageError):
        mean_image([grey_image(1), grey_image(1, bits=12)])


@pytest.fixture(scope="module")
def averaged(quick: Session) -> Session:
    """The same site, its reference the mean of eight pairs."""
    world = quick.world
    times = [reference_utc(world.settings) - timedelta(seconds=k) for k in range(8)]
    main, sub = (mean_image([grey(world, role, t) for t in times]) for role in ("main", "sub"))
    views = tuple(
        replace(view, main=main, sub=sub) if view.role is ViewRole.REFERENCE else view
        for view in quick.views
    )
    calibration, report = calibrate(views, quick.site)
    return replace(quick, views=views, calibration=calibration, report=report)


def test_a_calibration_on_a_mean_measures_as_one_on_a_single_pair(
    quick: Session, averaged: Session
) -> None:
    """Nothing is left out, levels are those of the 8-bit views, and rows agree and are good."""
    single, mean = quick.calibration.calibrated, averaged.calibration.calibrated
    assert averaged.report.figures["rejected"] == []
    assert averaged.report.passed == quick.report.passed
    assert mean.baseline.sub_contrast_dn == pytest.approx(single.baseline.sub_contrast_dn, rel=0.01)
    assert mean.baseline.main_contrast_dn == pytest.approx(
        single.baseline.main_contrast_dn, rel=0.01
    )
    for row, other in zip(averaged.rows(3), quick.rows(3), strict=True):
        assert row.measurement.flag is Flag.GOOD
        apart_mm = np.abs(row.measurement.corrected.mm - other.measurement.corrected.mm)
        assert (apart_mm < 0.5 * other.sigma_mm).all()


def test_the_mean_has_less_noise(quick: Session, averaged: Session) -> None:
    """Measured as if it were a row: a pair scatters about the zero, the mean of eight less."""
    world, start = quick.world, reference_utc(quick.world.settings) - 10 * MINUTE
    single_mm, mean_mm = [], []
    for burst in range(5):
        times = [start - timedelta(seconds=10 * burst + k) for k in range(8)]
        main, sub = ([grey(world, role, t) for t in times] for role in ("main", "sub"))
        for into, pair in (
            (single_mm, (main[0], sub[0])),
            (mean_mm, (mean_image(main), mean_image(sub))),
        ):
            seen = measure_pair(*pair, quick.site, quick.calibration)
            assert seen.corrected is not None
            into.append(seen.corrected.mm)
    assert np.std(mean_mm, axis=0).max() < 0.6 * np.std(single_mm, axis=0).max()


def test_a_disturbed_board_is_noticed_as_before(averaged: Session) -> None:
    """The level that residuals are held against is not that of 16-bit grey values."""
    main, sub = averaged.pair(averaged.world.settings.start_utc + 60 * MINUTE)
    speckled = sub.pixels.astype(float)
    speckled += np.random.default_rng(1).normal(0.0, 25.0, speckled.shape)
    pixels = np.clip(np.rint(speckled), 0, 255).astype(np.uint8)
    seen = measure_pair(main, GreyImage(pixels), averaged.site, averaged.calibration)
    assert Reason.SUB_TARGET_DISTURBED in seen.reasons
