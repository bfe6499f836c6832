"""Images that look right but are mirrored or turned: the rig's turns tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from core.calibration.calibrate import CalibrationView, calibrate
from core.errors import CalibrationError
from core.images import GreyImage
from core.site import RigPrior
from tests.core.sessions import Session

REVERSED = {
    "mirrored (left and right exchanged)": np.fliplr,
    "flipped (top and bottom exchanged)": np.flipud,
    "turned by 180 degrees": np.rot90,
}


def changed(
    views: tuple[CalibrationView, ...], camera: str, change: Callable[..., np.ndarray]
) -> list[CalibrationView]:
    """All views with one camera's images reversed, as the camera itself can do it."""
    turns = (2,) if change is np.rot90 else ()

    def reversed_(image: GreyImage | None) -> GreyImage | None:
        if image is None:
            return None
        return GreyImage(np.ascontiguousarray(change(image.pixels, *turns)))

    return [replace(view, **{camera: reversed_(getattr(view, camera))}) for view in views]


@pytest.mark.parametrize("what", REVERSED)
def test_a_plate_that_looks_the_same_in_a_reversed_image(quick: Session, what: str) -> None:
    """Five discs in a cross."""
    with pytest.raises(CalibrationError, match="ReverseX and ReverseY") as error:
        calibrate(changed(quick.views, "main", REVERSED[what]), quick.site)
    assert f"as if one of them were {what};" in str(error.value)


def test_a_board_that_looks_the_same_in_a_reversed_image(quick: Session) -> None:
    """Its colours are those of one that is not: even x odd squares, top and bottom exchanged."""
    with pytest.raises(CalibrationError, match="as if one of them were flipped"):
        calibrate(changed(quick.views, "sub", np.flipud), quick.site)


def test_cameras_drawn_as_looking_the_same_way(quick: Session) -> None:
    drawn = RigPrior(np.zeros(3), 1.0, quick.site.rig.offset_main_sub_mm, 3.0)
    with pytest.raises(
        CalibrationError, match=r"correct \[rig\] rotation_main_sub_deg = \[0, 0, 0\]"
    ):
        calibrate(quick.views, replace(quick.site, rig=drawn))
