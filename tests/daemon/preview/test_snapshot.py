"""What a preview shows for focusing: the camera's own pixels around the target."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from daemon.config.reading import load_config
from daemon.devices import open_clock, open_simulated_rig
from daemon.preview.snapshot import DETAIL_PX, take_snapshot
from drivers.protocols import CapturedFrame, CapturedPair
from tests.laboratory import laboratory

WHEN = datetime(2026, 3, 1, tzinfo=UTC)
TURN_DEG = (0.06, 0.03)
"""Of the head: the main target is then far from the middle of its image."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A pair, and where the simulation has put the targets in it."""

    site: object
    pair: CapturedPair
    discs_px: np.ndarray
    corners_px: np.ndarray


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("preview") / "dcam.toml"
    path.write_text(
        laboratory(1280, "simulated") + "[simulation]\nseed = 3\nstart_utc = 2026-03-01T00:00:00Z\n"
    )
    config = load_config(path)
    rig = open_simulated_rig(config, open_clock(config))
    rig.world.turn_head(*TURN_DEG)
    pair = rig.source.capture(WHEN)
    corners_px = rig.world.board_corners_px(WHEN).reshape(-1, 2)
    return Scene(config.site(), pair, rig.world.disc_centres_px(WHEN), corners_px)


def decoded(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def place_of(detail: np.ndarray, frame: CapturedFrame) -> tuple[int, int]:
    """Where a cut-out's top-left pixel is in the frame, if all its pixels are the frame's."""
    score = cv2.matchTemplate(frame.pixels, detail, cv2.TM_SQDIFF)
    _, _, (x, y), _ = cv2.minMaxLoc(score)
    height, width = detail.shape
    assert (detail == frame.pixels[y : y + height, x : x + width]).all()
    return x, y


def middle_of(detail: np.ndarray, frame: CapturedFrame) -> np.ndarray:
    return np.array(place_of(detail, frame)) + (np.array(detail.shape[::-1]) - 1) / 2.0


def test_the_detail_is_the_frame_pixel_for_pixel_around_the_target(scene: Scene) -> None:
    look = take_snapshot(scene.pair, scene.site, WHEN)
    main = decoded(look.pictures["main_detail.png"])
    assert main.shape == (DETAIL_PX, DETAIL_PX)
    true_middle_px = (scene.discs_px.min(axis=0) + scene.discs_px.max(axis=0)) / 2.0
    assert np.abs(true_middle_px - [639.5, 399.5]).max() > 50, "not in the image's own middle"
    assert middle_of(main, scene.pair.main) == pytest.approx(true_middle_px, abs=1.5)
    off = look.cameras["main"].off_centre_px
    assert off == pytest.approx(true_middle_px - [639.5, 399.5], abs=1.0)


def test_the_detail_of_the_sub_camera_is_around_the_middle_of_the_board(scene: Scene) -> None:
    detail = decoded(take_snapshot(scene.pair, scene.site, WHEN).pictures["sub_detail.png"])
    seen = scene.corners_px
    seen = seen[((seen > 0) & (seen < [1279, 799])).all(axis=1)]
    true_middle_px = (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    square_px = np.hypot(*(scene.corners_px[1] - scene.corners_px[0]))
    assert middle_of(detail, scene.pair.sub) == pytest.approx(true_middle_px, abs=square_px)


def test_the_detail_stays_on_a_target_whose_discs_are_partly_hidden(scene: Scene) -> None:
    pixels = scene.pair.main.pixels.copy()
    x, y = scene.discs_px[0].astype(int)
    pixels[y - 60 : y + 60, x - 60 : x + 60] = 40
    main = replace(scene.pair.main, pixels=pixels)
    look = take_snapshot(replace(scene.pair, main=main), scene.site, WHEN)
    assert look.cameras["main"].found == "4 of 5 discs found"
    true_middle_px = (scene.discs_px.min(axis=0) + scene.discs_px.max(axis=0)) / 2.0
    detail = decoded(look.pictures["main_detail.png"])
    assert middle_of(detail, main) == pytest.approx(true_middle_px, abs=2.5)


@pytest.mark.parametrize("bits", [8, 12])
def test_while_nothing_is_found_the_detail_is_the_middle_of_the_image(
    scene: Scene, bits: int
) -> None:
    """There, in most cases, is what the lens is being focused on."""
    noise = np.random.default_rng(1).integers(0, 2**bits, (800, 1280)).astype(np.uint16)
    frame = replace(
        scene.pair.main, pixels=noise if bits > 8 else noise.astype(np.uint8), bits=bits
    )
    look = take_snapshot(CapturedPair(frame, frame, 0.0), scene.site, WHEN)
    assert look.cameras["main"].off_centre_px is None
    for name in ("main_detail.png", "sub_detail.png"):
        assert (decoded(look.pictures[name]) == (noise >> (bits - 8))[160:640, 400:880]).all()


def test_a_target_at_the_border_is_shown_with_what_there_is_around_it(scene: Scene) -> None:
    """The cut-out does not leave the image, and is no smaller for it."""
    pixels = np.roll(scene.pair.main.pixels, (0, -250), axis=(0, 1))
    main = replace(scene.pair.main, pixels=pixels)
    look = take_snapshot(replace(scene.pair, main=main), scene.site, WHEN)
    place = place_of(decoded(look.pictures["main_detail.png"]), main)
    assert min(place) >= 0
    assert decoded(look.pictures["main_detail.png"]).shape == (DETAIL_PX, DETAIL_PX)


EXTRA = """
[[target.extra]]
name = "abutment"
role = "fixed"
kind = "circles"
centres_mm = [[-6.0, 8.0], [6.0, 8.0], [-2.0, -8.0]]
diameter_mm = 5.0
distance_mm = 11500.0
distance_sigma_mm = 20.0

[[target.extra]]
name = "span-2"
role = "measured"
kind = "circles"
centres_mm = [[-12.0, 3.0], [12.0, 3.0], [-4.0, -7.0], [12.0, -7.0]]
diameter_mm = 5.0
distance_mm = 12000.0
distance_sigma_mm = 20.0
"""
PLACE_PX = (1150, 640)


def with_further(scene: Scene, tmp_path: Path, pixels: np.ndarray) -> tuple[object, CapturedPair]:
    """A site with two further targets, and a pair with the first of them painted into it."""
    path = tmp_path / "dcam.toml"
    path.write_text(laboratory(1280) + EXTRA)
    site = load_config(path).site()
    target = site.extra_targets[0].target
    scale = site.main.focal_px / target.distance_mm
    x, y = PLACE_PX
    plate = np.full((200, 180), 30, np.uint8)
    for centre, diameter in zip(target.centres_mm, target.diameters_mm, strict=True):
        at = np.rint(([90, 100] + centre * [1, -1] * scale) * 16).astype(int)
        cv2.circle(plate, at, round(diameter / 2 * scale * 16), 220, -1, cv2.LINE_AA, 4)
    pixels = pixels.copy()
    pixels[y - 100 : y + 100, x - 90 : x + 90] = cv2.GaussianBlur(plate, (0, 0), 0.8)
    return site, replace(scene.pair, main=replace(scene.pair.main, pixels=pixels))


def test_of_each_further_target_it_is_said_whether_it_is_found(
    scene: Scene, tmp_path: Path
) -> None:
    site, pair = with_further(scene, tmp_path, scene.pair.main.pixels)
    look = take_snapshot(pair, site, WHEN)
    assert look.cameras["main"].found == "5 of 5 discs found"
    seen, unseen = look.cameras["main"].further
    assert (seen.name, seen.role, seen.is_found) == ("abutment", "fixed", True)
    assert seen.text == "3 of 3 discs found, position_px 1150, 640"
    assert (unseen.name, unseen.is_found, unseen.text) == ("span-2", False, "not found")
    assert look.cameras["sub"].further == ()
    green = (decoded(look.pictures["main.jpg"])[420:540, 810:915] @ [-1.0, 2.0, -1.0]).max()
    assert green > 100, "what is found of it is marked"


def test_further_targets_are_said_while_the_main_one_is_not_in_view(
    scene: Scene, tmp_path: Path
) -> None:
    """As when the camera is aimed, and the fixed target comes into view first."""
    site, pair = with_further(scene, tmp_path, np.full_like(scene.pair.main.pixels, 40))
    look = take_snapshot(pair, site, WHEN)
    assert look.cameras["main"].off_centre_px is None
    seen, unseen = look.cameras["main"].further
    assert (seen.is_found, unseen.is_found) == (True, False)


def test_a_site_without_further_targets_says_nothing_of_any(scene: Scene) -> None:
    assert take_snapshot(scene.pair, scene.site, WHEN).cameras["main"].further == ()
