"""What a preview shows for focusing: the camera's own pixels around the target."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime

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
