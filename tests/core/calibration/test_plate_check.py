"""A main target that is drawn wrong does not pass, and what is wrong of it is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.calibration.calibrate import CalibrationReport, ViewRole, calibrate
from core.calibration.plate_check import plate_problem
from core.errors import CalibrationError
from core.recognition import recognise_discs
from core.site import CirclesTarget
from tests.core.sessions import Session


def problem(session: Session, centres_mm: np.ndarray) -> str | None:
    """What is said of a drawing, by the reference image of the true plate."""
    image = session.pair(session.world.settings.start_utc)[0]
    target = session.site.main_target
    found = recognise_discs(image, session.site)
    return plate_problem(image, found, replace(target, centres_mm=centres_mm))


def drawn(session: Session, centres_mm: np.ndarray) -> CalibrationReport:
    target: CirclesTarget = replace(session.site.main_target, centres_mm=centres_mm)
    return calibrate(session.views, replace(session.site, main_target=target))[1]


def test_a_true_drawing_is_no_problem(quick: Session) -> None:
    assert problem(quick, quick.site.main_target.centres_mm) is None


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        ((1.0, 1.04), "have all y 0.96"),
        ((1.05, 1.0), "have all x 0.95"),
        ((0.95, 1.0), "have all x 1.05"),
    ],
)
def test_a_plate_drawn_too_long_one_way(quick: Session, factors: tuple, said: str) -> None:
    """Of round discs only one drawing makes circles."""
    found = problem(quick, quick.site.main_target.centres_mm * np.array(factors))
    assert found is not None
    assert said in found


def test_a_disc_drawn_at_a_wrong_place(quick: Session) -> None:
    """In a cross of five, its opposite could be wrong as well."""
    centres_mm = quick.site.main_target.centres_mm.copy()
    x_mm, y_mm = centres_mm[0]
    centres_mm[0] += (1.5, 0.0)
    found = problem(quick, centres_mm)
    assert found is not None
    assert f"disc 1 is at [{x_mm:.1f}, {y_mm:.1f}], not at [{x_mm + 1.5:g}, {y_mm:g}]" in found
    assert found.count("disc ") == 2


def test_it_does_not_pass(quick: Session) -> None:
    report = drawn(quick, quick.site.main_target.centres_mm * np.array([1.0, 1.04]))
    assert not report.passed
    assert (
        "calibration NOT passed: target.main.centres_mm should likely have all y"
        in (report.lines[0])
    )


def test_discs_on_one_line_are_too_few(quick: Session) -> None:
    """The plate's scale across that line cannot be known: no number is made of it."""
    views = list(quick.views)
    (k,) = (k for k, view in enumerate(views) if view.role is ViewRole.REFERENCE)
    image = views[k].main
    assert image is not None
    seen = recognise_discs(image, quick.site)
    hidden = image.pixels.copy()
    for x, y in seen.points_px[[1, 3]].round().astype(int):
        hidden[y - 30 : y + 31, x - 30 : x + 31] = np.percentile(hidden, 5)
    views[k] = replace(views[k], main=replace(image, pixels=hidden))
    with pytest.raises(CalibrationError, match=r"3 of the main target's 5 discs .* too few"):
        calibrate(views, quick.site)
