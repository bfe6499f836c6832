"""A wrong number of the config does not pass, and is named with what it should be."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from core.calibration.calibrate import calibrate
from core.calibration.survey_check import Group, Quantity, SurveyCheck
from tests.core.sessions import Session


def plate(distance: float, diameter: float) -> Group:
    """A main target at 11 m of discs of 8 mm, seen at these multiples of both."""
    return Group(
        (
            Quantity("d", "mm", (11000.0, 11000.0), 11000.0 * distance, 0.003, {"D": 1, "L": -1}),
            Quantity("w", "mm", (8.0, 8.0), 8.0 * diameter, 0.015, {"W": 1, "L": -1}),
        ),
        {"D": 11000.0, "L": 1.0, "W": 8.0},
        "measure",
    )


@pytest.mark.parametrize(
    ("distance", "diameter", "said"),
    [
        (0.9, 1.0, "D is likely about 9900, not 11000:"),
        (1.0, 0.8, "W is likely about 6.4, not 8:"),
        (0.8, 0.8, "L is likely about 1.25, not 1:"),
        (0.9, 0.7, "L is likely about 1.11, not 1 and W is likely about 6.22, not 8, or D is"),
    ],
    ids=["distance", "diameter", "centres", "two numbers"],
)
def test_the_fewest_numbers_that_explain_the_images_are_named(distance, diameter, said) -> None:
    problem = plate(distance, diameter).problem
    assert problem is not None
    assert problem.startswith(said)


def test_what_is_within_its_sigma_is_no_problem() -> None:
    assert plate(1.01, 1.05).problem is None


def test_a_focused_lens_is_longer_than_engraved() -> None:
    """A 6 mm lens focused at 50 mm has its image 6.82 mm behind it; makers err by some per cent."""
    lens = Quantity("f", "px", (1024.0, 1163.0), 1160.0, 0.025, {"f": 1})
    assert lens.sigmas == 0.0
    assert replace(lens, seen=1400.0).sigmas == pytest.approx(7.42, abs=0.01)
    problem = Group((replace(lens, seen=1400.0),), {"f": 6.0, "p": 5.86}, "read it").problem
    assert problem is not None
    assert problem.startswith("f is likely 7.04 to 8.41, not 6:")


def test_what_is_doubtful_is_a_warning() -> None:
    far = Quantity("board", "mm", (50.0, 50.0), 53.0, 0.02, {"b": 1})
    lines = SurveyCheck((Group((far,), {"b": 50.0}, "measure it"),), "by hand").lines
    assert "warning: board: 2.9 sigma off; measure it" in lines


def test_a_true_config_passes_and_the_report_shows_what_was_compared(quick: Session) -> None:
    assert quick.report.passed
    off = [abs(quantity["off_sigmas"]) for quantity in quick.report.figures["survey"]]
    assert len(off) == 5
    assert max(off) < 3.0
    assert any(line.startswith("measure by hand") for line in quick.report.lines)


def test_squares_of_another_size_do_not_pass(quick: Session) -> None:
    """3 mm in the config, 2 mm printed: the board would be half as far away again as drawn."""
    target = replace(quick.site.sub_target, square_mm=3.0)
    _, report = calibrate(quick.views, replace(quick.site, sub_target=target))
    assert not report.passed
    assert "target.sub.square_mm is likely about 2, not 3" in report.lines[0]
    assert "22 x 15 squares are 66.0 x 45.0 mm" in report.lines[0]


@pytest.mark.parametrize("factor", [0.5, 1.4])
def test_a_distance_that_is_far_off_is_named_with_the_true_one(
    quick: Session, factor: float
) -> None:
    """Neither extrapolated from far away, nor the focal length blamed for it."""
    drawn_mm = factor * quick.site.main_target.distance_mm
    target = replace(quick.site.main_target, distance_mm=drawn_mm)
    _, report = calibrate(quick.views, replace(quick.site, main_target=target))
    assert not report.passed
    found = re.search(r"main\.distance_mm is likely about (\d+), not", report.lines[0])
    assert found is not None
    true_mm = quick.world.site.main_target.distance_mm
    assert float(found[1]) == pytest.approx(true_mm, rel=0.01)
    assert "focal_length_mm" not in report.lines[0]


def test_a_board_beyond_what_printers_do_is_a_warning(quick: Session) -> None:
    """3 % may be its distance, which is known to 2 %: what to measure is said."""
    target = replace(quick.site.sub_target, square_mm=2.06)
    _, report = calibrate(quick.views, replace(quick.site, sub_target=target))
    (warning,) = [line for line in report.lines if line.startswith("warning: target.sub.")]
    assert "printers err by 1% at most" in warning
    assert "22 x 15 squares are 45.3 x 30.9 mm" in warning
    found = re.search(r"square_mm is likely ([\d.]+);", warning)
    assert found is not None
    assert float(found[1]) == pytest.approx(2.0, rel=0.01)
    assert not any(line.startswith("warning: target.sub.") for line in quick.report.lines)
