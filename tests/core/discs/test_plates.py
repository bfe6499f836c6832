"""Several plates in one image are told apart, and one that is hidden costs its own values only."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from core.arrays import FloatArray
from core.discs.disc_finder import Discs
from core.discs.plates import WantedPlate, find_plates, find_plates_near
from core.errors import TargetNotFoundError
from core.images import GreyImage
from core.site import CirclesTarget

CENTRES_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]])
OTHER_MM = np.array([[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0]])
PX_PER_MM = 5.0


def target(size: float = 1.0, centres_mm: FloatArray = CENTRES_MM) -> CirclesTarget:
    return CirclesTarget(size * centres_mm, np.full(len(centres_mm), 8.0 * size), 11000.0, 20.0)


def wanted(name: str, drawn: CirclesTarget) -> WantedPlate:
    return WantedPlate(name, drawn, PX_PER_MM)


def image(*plates: tuple[CirclesTarget, float, float]) -> GreyImage:
    """Plates with their middles at x, y, px."""
    fine, rng = 4, np.random.default_rng(1)
    pixels = np.full((400 * fine, 640 * fine), 60, np.uint8)
    for drawn, x, y in plates:
        low, high = (
            np.array([x, y]) + PX_PER_MM * side * (np.ptp(drawn.centres_mm, axis=0) / 2 + 8.0)
            for side in (-1, 1)
        )
        corners = [tuple(int(v) for v in fine * corner) for corner in (low, high)]
        cv2.rectangle(pixels, corners[0], corners[1], 20, -1)
        for (dx, dy), diameter in zip(drawn.centres_mm, drawn.diameters_mm, strict=True):
            at = (fine * (x + PX_PER_MM * dx), fine * (y - PX_PER_MM * dy))
            radius = round(fine * PX_PER_MM * diameter / 2)
            cv2.circle(pixels, (round(at[0]), round(at[1])), radius, 200, -1)
    grey = cv2.resize(pixels, (640, 400), interpolation=cv2.INTER_AREA).astype(float)
    return GreyImage(np.clip(grey + rng.normal(0.0, 1.0, grey.shape), 0, 255).astype(np.uint8))


def middle(discs: Discs | None) -> list[float]:
    assert discs is not None
    return np.nanmean(discs.points_px, axis=0).round(0).tolist()


def test_alike_plates_of_two_sizes_are_told_apart_without_a_hint() -> None:
    seen = image((target(), 200, 200), (target(0.5), 480, 150))
    small, large = find_plates(seen, [wanted("small", target(0.5)), wanted("large", target())])
    assert (middle(small), middle(large)) == ([480.0, 150.0], [200.0, 200.0])


def test_plates_of_two_layouts_are_told_apart() -> None:
    other = target(centres_mm=OTHER_MM)
    seen = image((target(), 200, 200), (other, 460, 200))
    plates = [wanted("other", other), wanted("main", target())]
    found = find_plates(seen, plates)
    assert [middle(discs)[0] < 300.0 for discs in found] == [False, True]


def test_equal_plates_are_refused_until_somebody_says_where_one_is() -> None:
    seen = image((target(), 180, 200), (target(), 460, 200))
    plates = [wanted("main target", target()), wanted('target "abutment"', target())]
    with pytest.raises(TargetNotFoundError, match=r"look alike.*position_px"):
        find_plates(seen, plates)
    hinted = replace(plates[1], near_px=np.tile([430.0, 230.0], (5, 1)), rough=True)
    assert [middle(discs)[0] for discs in find_plates(seen, [plates[0], hinted])] == [180.0, 460.0]


def test_equal_plates_are_known_again_when_all_have_shifted() -> None:
    before = image((target(), 150, 200), (target(), 370, 200))
    hint = replace(
        wanted('target "b"', target()), near_px=np.tile([370.0, 200.0], (5, 1)), rough=True
    )
    found = find_plates(before, [wanted("a", target()), hint])
    plates = [
        replace(wanted(name, target()), near_px=discs.points_px)
        for name, discs in zip("ab", found, strict=True)
        if discs is not None
    ]
    # Plate a is now nearly where b was.
    after = image((target(), 320, 190), (target(), 540, 190))
    assert [middle(discs)[0] for discs in find_plates(after, plates)] == [320.0, 540.0]


def test_a_hidden_plate_costs_only_itself() -> None:
    seen = image((target(), 200, 200))
    missing, found = find_plates(seen, [wanted("small", target(0.5)), wanted("main", target())])
    assert missing is None
    assert middle(found) == [200.0, 200.0]


def test_the_main_plate_is_not_taken_for_a_hidden_fixed_one() -> None:
    places = {"fixed": [440.0, 200.0], "main": [200.0, 200.0]}
    plates = [
        replace(wanted(name, target()), near_px=np.array(at) + PX_PER_MM * CENTRES_MM * [1, -1])
        for name, at in places.items()
    ]
    both = find_plates_near(image((target(), 210, 195), (target(), 441, 201)), plates, [75, 120])
    assert [middle(discs) for discs in both] == [[441.0, 201.0], [210.0, 195.0]]
    alone = find_plates_near(image((target(), 210, 195)), plates, [75, 120])
    assert alone[0] is None
    assert middle(alone[1]) == [210.0, 195.0]


def test_a_plate_is_as_sharp_among_others_as_alone() -> None:
    """The discs' places do not depend on how the plate was found."""
    alone = find_plates(image((target(), 200, 200)), [wanted("main", target())])[0]
    other = image((target(), 200, 200), (target(0.5), 480, 150))
    among = find_plates(other, [wanted("main", target()), wanted("small", target(0.5))])[0]
    assert alone is not None
    assert among is not None
    np.testing.assert_allclose(among.points_px, alone.points_px, atol=0.02)
