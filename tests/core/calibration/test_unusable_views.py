"""Views that cannot be used are rejected by name; too few are refused with what is missing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from core.calibration.calibrate import CalibrationView, Method, ViewRole, calibrate
from core.errors import CalibrationError, NotObservableError
from core.geometry.pose import Pose
from core.images import GreyImage
from core.site import CheckerboardTarget, Site
from drivers.sim.geometry import held_board_pose
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.core.boards import BoardScene
from tests.core.scenes import head_positions, lens_views, small_site
from tests.core.sessions import Session, all_views

Change = Callable[[np.ndarray], np.ndarray]
Views = Sequence[CalibrationView]


def _rejected(session: Session, changes: dict[int, dict[str, object]]) -> dict[str, str]:
    """Views rejected when some are changed, with their reasons; the rest makes a calibration."""
    views = list(session.views)
    for index, change in changes.items():
        views[index] = replace(views[index], **change)
    _, report = calibrate(views, session.site)
    assert report.passed
    reasons = {r["view"]: r["reason"] for r in report.figures["rejected"]}
    for name, reason in reasons.items():
        assert f"rejected {name}: {reason}" in report.lines
    return reasons


def _stretched(image: GreyImage, factor: float) -> GreyImage:
    matrix = np.array([[factor, 0.0, (1.0 - factor) * image.pixels.shape[1] / 2], [0.0, 1.0, 0.0]])
    size = image.pixels.shape[::-1]
    return GreyImage(cv2.warpAffine(image.pixels, matrix, size, borderMode=cv2.BORDER_REPLICATE))


def test_views_that_show_too_little_are_rejected_by_name(quick: Session) -> None:
    """A blank image, another board, no main image, a wrong size: each with its own reason."""
    other = replace(quick.site.sub_target, squares_x=30, squares_y=20, square_mm=1.4)
    blank = GreyImage(np.full_like(quick.views[0].sub.pixels, 90))
    reasons = _rejected(
        quick,
        {
            0: {"sub": blank},
            1: {"sub": BoardScene(target=other).image()},
            8: {"main": None},
            10: {"sub": GreyImage(quick.views[10].sub.pixels[:200])},
        },
    )
    assert set(reasons) == {"lens 0", "lens 1", "rig 3", "rig 5"}
    assert reasons["lens 0"].startswith("no checkerboard")
    assert "the config says 22x15 squares" in reasons["lens 1"]
    assert reasons["rig 3"] == "no main image"
    assert "480x200" in reasons["rig 5"]


def _changed(views: Views, which: Iterable[int], change: Change) -> Views:
    """The views, the sub images of some changed."""
    changed = list(views)
    for k in which:
        pixels = np.ascontiguousarray(change(views[k].sub.pixels))
        changed[k] = replace(views[k], sub=GreyImage(pixels, views[k].sub.bits))
    return changed


def _mirrored(pixels: np.ndarray) -> np.ndarray:
    return pixels[:, ::-1]


def _turned(pixels: np.ndarray) -> np.ndarray:
    return pixels[::-1, ::-1]


@pytest.fixture(scope="module")
def whole() -> tuple[Site, Views]:
    """A site whose whole board is in the sub image: three lens views, the reference, six others."""
    site = small_site(sub_target=CheckerboardTarget(22, 13, 2.0, 50.0))
    world = World(site, SimSettings(seed=3))
    return site, all_views(world, 3, head_positions(site, 6))


@pytest.mark.parametrize("change", [_mirrored, _turned])
def test_a_rig_view_that_is_mirrored_or_turned_is_rejected_by_name(
    whole: tuple[Site, Views], change: Change
) -> None:
    site, views = whole
    _, report = calibrate(_changed(views, [6], change), site)
    assert report.passed
    (said,) = [line for line in report.lines if line.startswith("rejected ")]
    assert said.startswith("rejected rig 3: sub target: the board is seen upside down or mirrored")
    assert "ReverseX" in said


def test_where_all_rig_views_are_mirrored_the_first_is_named(
    whole: tuple[Site, Views], quick: Session
) -> None:
    """Also where the board is larger than the image, so that each view has a place on it."""
    said = "none of the rig views can be used; rig 1: sub target: .*upside down or mirrored"
    for site, views in (whole, (quick.site, quick.views)):
        rig = [k for k, view in enumerate(views) if view.role is ViewRole.RIG]
        with pytest.raises(CalibrationError, match=said):
            calibrate(_changed(views, rig, _mirrored), site)


@pytest.mark.parametrize(("index", "name"), [(2, "lens 2"), (8, "rig 3")])
def test_one_view_that_is_mirrored_is_said_to_be_so(quick: Session, index: int, name: str) -> None:
    """Also where the board is larger than the image, and where it may be held any way."""
    (mirrored,) = _changed(quick.views[index : index + 1], [0], _mirrored)
    reasons = _rejected(quick, {index: {"sub": mirrored.sub}})
    assert list(reasons) == [name]
    assert reasons[name].startswith("mirrored or turned by 180 degrees")
    assert "ReverseX" in reasons[name]


@pytest.mark.parametrize("change", [_mirrored, _turned])
def test_lens_views_that_are_all_mirrored_are_said_to_be_so(
    whole: tuple[Site, Views], change: Change
) -> None:
    """They fit one another, and a lens whose principal point is on the other side."""
    site, views = whole
    _, report = calibrate(_changed(views, range(3), change), site)
    assert not report.passed
    reasons = {r["view"]: r["reason"] for r in report.figures["rejected"]}
    assert list(reasons) == ["lens 0", "lens 1", "lens 2"]
    assert all(reason.startswith("mirrored or turned by 180") for reason in reasons.values())


def test_a_board_held_upside_down_is_not_mirrored(
    whole: tuple[Site, Views], monkeypatch: pytest.MonkeyPatch
) -> None:
    site, views = whole
    size_mm = np.array([site.sub_target.squares_x, site.sub_target.squares_y, 0])
    half = Pose(np.diag([-1.0, -1.0, 1.0]), size_mm * site.sub_target.square_mm)

    def upside_down(*given: object) -> Pose:
        return held_board_pose(*given).compose(half)

    monkeypatch.setattr("drivers.sim.world.held_board_pose", upside_down)
    held = lens_views(World(site, SimSettings(seed=3)), 3)
    _, report = calibrate([*held, *views[3:]], site)
    assert report.passed
    assert report.figures["rejected"] == []


def test_of_a_pair_the_image_that_is_at_fault_is_named(whole: tuple[Site, Views]) -> None:
    site, views = whole
    called = {"name": "6 (6_sub.png)", "main_name": "6 (6_main.png)"}
    spoilt = list(views)
    assert views[6].main is not None
    dark = GreyImage(np.full_like(views[6].main.pixels, 9))
    spoilt[6] = replace(views[6], main=dark, **called)
    _, report = calibrate(spoilt, site)
    (said,) = [line for line in report.lines if line.startswith("rejected ")]
    assert said.startswith("rejected 6 (6_main.png): main target: ")
    assert [entry["view"] for entry in report.figures["rejected"]] == ["6 (6_sub.png)"]


def test_a_lens_view_that_does_not_fit_is_rejected_by_name(quick: Session) -> None:
    """A hundredth wider than it should be: a board that was bent, or another lens."""
    reasons = _rejected(quick, {2: {"sub": _stretched(quick.views[2].sub, 1.01)}})
    assert list(reasons) == ["lens 2"]
    assert "mirrored" not in reasons["lens 2"]


# ------------------------------------------------------------------ refused


PAN_ONLY = [(a, 0.0) for a in (-0.15, -0.07, 0.06, 0.1, 0.14)]
TILT_ONLY = [(0.0, a) for a in (-0.08, -0.04, 0.03, 0.05, 0.07)]
TOGETHER = [(2 * a, a) for a in (-0.08, -0.04, 0.03, 0.05, 0.07)]


@pytest.mark.parametrize(
    ("motion", "missing", "method"),
    [
        (PAN_ONLY, "missing motion: tilt", Method.RIGID),
        (PAN_ONLY, "missing motion: tilt", Method.PAPER),
        (TILT_ONLY, "missing motion: pan", Method.RIGID),
        (TOGETHER, "always moved together", Method.RIGID),
        ([(0.0, 0.0)] * 5, "turned by only", Method.RIGID),
        ([(0.1, 0.05), (-0.1, 0.05), (0.1, -0.05)], "3 usable rig positions", Method.RIGID),
    ],
    ids=["pan only", "pan only, paper", "tilt only", "together", "at rest", "too few"],
)
def test_motions_that_determine_too_little_are_refused(quick, motion, missing, method) -> None:
    """The message names the motion that is missing."""
    rest = all_views(quick.world, 0, motion)
    with pytest.raises(NotObservableError, match=missing):
        calibrate([*quick.views[:5], *rest], quick.site, method)


def test_without_what_is_needed_the_error_says_what(quick: Session) -> None:
    lens, reference, rig = quick.views[:5], quick.views[5], quick.views[6:]
    assert reference.role is ViewRole.REFERENCE
    with pytest.raises(CalibrationError, match="0 reference views given, exactly one"):
        calibrate([*lens, *rig], quick.site)
    with pytest.raises(CalibrationError, match="2 reference views given, exactly one"):
        calibrate([*lens, reference, reference, *rig], quick.site)
    with pytest.raises(CalibrationError, match="no rig views"):
        calibrate([*lens, reference], quick.site)
    with pytest.raises(CalibrationError, match="0 reference views"):
        calibrate([], quick.site)


@pytest.mark.parametrize("which", ["main", "sub"])
def test_a_reference_that_shows_nothing_is_refused_by_name(quick: Session, which) -> None:
    black = GreyImage(np.zeros_like(getattr(quick.views[5], which).pixels))
    views = list(quick.views)
    views[5] = replace(views[5], **{which: black})
    with pytest.raises(CalibrationError, match=r"^reference: .*again"):
        calibrate(views, quick.site)
