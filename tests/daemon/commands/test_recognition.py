"""A target that is not recognised is named with its cure, by every command that looks at images."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.images import GreyImage
from core.recognition import disc_doubt, recognise_discs
from daemon.calibration.view_check import see_pair
from daemon.config.reading import load_config
from daemon.slots.snapshot import recognition_problems
from drivers.frameset import encode_png, read_frame_set, read_image
from drivers.protocols import CapturedFrame, CapturedPair
from drivers.sim.frameset_writer import FrameSetPlan, write_frame_set
from drivers.sim.settings import SimSettings
from tests.daemon.commands.conftest import LABORATORY, SEED, SIMULATED, Ctl

FARTHER = ("distance_mm = 50.0", "distance_mm = 60.0")
"""The whole board is in the image."""
UNLIKE_ITS_MIRROR = ("[15.0, -11.0]]", "[9.0, -11.0]]")
"""The usual five discs are the same mirrored."""
BOARD = "squares_x = 32\nsquares_y = 31"

Change = Callable[[np.ndarray], np.ndarray]


def same(pixels: np.ndarray) -> np.ndarray:
    return pixels


def mirrored(pixels: np.ndarray) -> np.ndarray:
    return pixels[:, ::-1]


def flipped(pixels: np.ndarray) -> np.ndarray:
    return pixels[::-1]


def turned(pixels: np.ndarray) -> np.ndarray:
    return pixels[::-1, ::-1]


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with `dcam.toml` and a small frame set that shows the whole board; not to change."""
    directory = tmp_path_factory.mktemp("whole")
    text = LABORATORY.replace(*FARTHER).replace(*UNLIKE_ITS_MIRROR)
    (directory / "dcam.toml").write_text(text)
    site = load_config(directory / "dcam.toml").site()
    write_frame_set(
        directory / "set",
        site,
        SimSettings(seed=SEED),
        FrameSetPlan(intrinsics=2, rig=2, measure=1),
    )
    return directory


Calibrate = Callable[..., str]


@pytest.fixture
def calibrate(ctl: Ctl, whole: Path, tmp_path: Path) -> Calibrate:
    """Calibrate on the set with changed images and config; give the one line of its error."""

    def ran(main: Change = same, sub: Change = same, *config: tuple[str, str]) -> str:
        frames = Path(shutil.copytree(whole / "set", tmp_path / "set", dirs_exist_ok=True))
        for row in read_frame_set(frames).rows_of("reference", "rig"):
            for name, change in ((row.main, main), (row.sub, sub)):
                image = read_image(frames / str(name))
                pixels = np.ascontiguousarray(change(image.pixels))
                (frames / str(name)).write_bytes(encode_png(pixels, image.bits))
        text = (whole / "dcam.toml").read_text()
        for old, new in config:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "dcam.toml").write_text(text)
        given = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
        answer = ctl(*given, "calibrate", "--from", frames)
        assert answer.code != 0
        (line,) = answer.err.splitlines()
        return line

    return ran


def test_targets_as_configured_are_recognised(calibrate: Calibrate) -> None:
    """What is wrong with the small set is that two positions are too few."""
    assert "target" not in calibrate()


@pytest.mark.parametrize("change", [mirrored, turned])
def test_mirrored_or_upside_down_board(calibrate: Calibrate, change: Change) -> None:
    """A board of 32 x 31 squares looks the same in both: the writing beside it tells them apart."""
    said = calibrate(same, change)
    assert "dcam-ctl: error: reference 20" in said
    assert "_sub.png)" in said
    assert "upside down or mirrored" in said
    assert "ReverseX" in said
    assert "turn the board by 180 degrees" in said


@pytest.mark.parametrize(
    ("x", "y", "cure"),
    [
        (31, 32, "set target.sub.squares_x = 32, squares_y = 31"),
        (31, 30, "counts inner corners; count squares: set target.sub.squares_x = 32"),
        (31, 31, "correct target.sub.squares_x"),
        (33, 31, "set target.sub.squares_x = 32"),
        (32, 32, "set target.sub.squares_y = 31"),
        (33, 32, "set target.sub.squares_x = 32 and target.sub.squares_y = 31"),
        (10, 7, "mount the board of the config"),
    ],
)
def test_wrong_count_of_squares(calibrate: Calibrate, x: int, y: int, cure: str) -> None:
    said = calibrate(same, same, (BOARD, f"squares_x = {x}\nsquares_y = {y}"))
    assert "sub target" in said
    assert f"{x}" in said
    assert cure in said
    assert "again" not in said


@pytest.mark.parametrize(
    ("change", "what", "cure"),
    [
        (mirrored, "the image is mirrored", "ReverseX"),
        (flipped, "the image is flipped", "ReverseY"),
        (turned, "upside down", "by 180 degrees"),
    ],
)
def test_main_image_not_the_right_way_round(
    calibrate: Calibrate, change: Change, what: str, cure: str
) -> None:
    said = calibrate(change)
    assert "dcam-ctl: error: reference 20" in said
    assert "_main.png): main target" in said
    assert what in said
    assert cure in said
    assert "take the reference again" not in said


def dark(pixels: np.ndarray) -> np.ndarray:
    """Noise, and one pixel that is hot."""
    pixels = np.random.default_rng(1).integers(2, 6, pixels.shape).astype(np.uint8)
    pixels[3, 4] = 255
    return pixels


def white(pixels: np.ndarray) -> np.ndarray:
    return np.full_like(pixels, 255)


@pytest.mark.parametrize("role", ["main", "sub"])
def test_a_black_or_overexposed_reference_is_said_to_be_so(calibrate: Calibrate, role: str) -> None:
    said = calibrate(**{role: dark})
    assert f"_{role}.png): {role} target: the image is black, its brightest pixel at 2.0 %" in said
    assert "take the cap off the lens" in said
    assert f"a longer [exposure] {role}_us; take the reference again" in said
    said = calibrate(**{role: white})
    assert f"_{role}.png): {role} target: the image is overexposed, 100 % of its pixels" in said
    assert f"a shorter [exposure] {role}_us; take the reference again" in said


def test_a_black_pair_is_said_to_be_so_before_a_calibration(whole: Path) -> None:
    site = load_config(whole / "dcam.toml").site()
    blank = np.zeros((site.main.height_px, site.main.width_px), np.uint8)
    shot = CapturedFrame(dark(blank), 8, 0, 0, 0.0)
    pair = CapturedPair(shot, shot, None)
    for problems in (recognition_problems(pair, site), see_pair(pair, site).problems):
        for role, problem in zip(("main", "sub"), problems, strict=True):
            assert problem.startswith(f"{role} target: the image is black, its brightest pixel at")
            assert problem.endswith(f"or set a longer [exposure] {role}_us")


def test_wrong_diameter_of_the_discs(calibrate: Calibrate) -> None:
    said = calibrate(same, same, ("diameter_mm = 8.0", "diameter_mm = 4.0"))
    assert "target.main.diameter_mm" in said
    assert "about 8" in said
    assert "again" not in said


def test_discs_a_third_wider_than_they_are_are_named(calibrate: Calibrate) -> None:
    """Too narrow in the image for a fit to begin: not discs that something covers."""
    said = calibrate(same, same, ("diameter_mm = 8.0", "diameter_mm = 10.4"))
    assert "for their distances from one another, as target.main.diameter_mm says" in said
    assert "about 8" in said
    assert "clear" not in said


WIDE = r"diameter_mm says; measure them: about ([\d.]+) mm"
APART = r"target.main.centres_mm should all be ([\d.]+) times"
LARGE = r"seen, ([\d.]+) times .*; correct camera.main.focal_length_mm, target.main"
SIZES = [
    *(("diameter", factor, WIDE, 8.0) for factor in (0.75, 1.2, 1.25)),
    *(("centres", factor, APART, 1.0 / factor) for factor in (0.75, 0.8, 1.2, 1.3)),
    *(("both", factor, LARGE, 1.0 / factor) for factor in (0.75, 1.3)),
]
"""What is drawn wrongly in the config, by which factor, and what is said with which number."""


@pytest.mark.parametrize(("wrong", "factor", "said", "number"), SIZES)
def test_a_plate_of_another_size_is_named_with_the_number_that_is_likely_wrong(
    whole: Path, wrong: str, factor: float, said: str, number: float
) -> None:
    """And the number can be typed in: it is right to a per cent, two as the lens is engraved."""
    site = load_config(whole / "dcam.toml").site()
    (row,) = read_frame_set(whole / "set").rows_of("measure")
    image = read_image(whole / "set" / str(row.main))
    drawn = site.main_target
    plate = replace(
        drawn,
        diameters_mm=drawn.diameters_mm * (1.0 if wrong == "centres" else factor),
        centres_mm=drawn.centres_mm * (1.0 if wrong == "diameter" else factor),
    )
    shot = CapturedFrame(image.pixels, image.bits, 0, 0, 0.0)
    sub = read_image(whole / "set" / str(row.sub))
    pair = CapturedPair(shot, replace(shot, pixels=sub.pixels, bits=sub.bits), None)
    assert recognition_problems(pair, site) == []
    (problem,) = recognition_problems(pair, replace(site, main_target=plate))
    found = re.search(said, problem)
    assert found, problem
    assert float(found[1]) == pytest.approx(number, rel=0.02 if wrong == "both" else 0.01)
    (looked,) = see_pair(pair, replace(site, main_target=plate)).problems[:1]
    assert looked == problem


def test_a_distance_that_the_survey_leaves_open_is_not_doubted(whole: Path) -> None:
    site = load_config(whole / "dcam.toml").site()
    (row,) = read_frame_set(whole / "set").rows_of("measure")
    stored = read_image(whole / "set" / str(row.main))
    image = GreyImage(stored.pixels, stored.bits)
    far = replace(site.main_target, distance_mm=1.3 * site.main_target.distance_mm)
    discs = recognise_discs(image, replace(site, main_target=far))
    assert disc_doubt(image, discs, replace(site, main_target=far)) is not None
    unsure = replace(far, distance_sigma_mm=0.1 * far.distance_mm)
    assert disc_doubt(image, discs, replace(site, main_target=unsure)) is None


def test_swapped_images_are_swapped_cameras(ctl: Ctl, whole: Path, tmp_path: Path) -> None:
    frames = Path(shutil.copytree(whole / "set", tmp_path / "set"))
    for row in read_frame_set(frames).rows_of("reference", "rig"):
        main, sub = (frames / str(name) for name in (row.main, row.sub))
        main.rename(frames / "kept.png")
        sub.rename(main)
        (frames / "kept.png").rename(sub)
    given = ("--config", whole / "dcam.toml", "--state", tmp_path / "state")
    said = ctl(*given, "calibrate", "--from", frames).err
    assert "the cameras are swapped" in said
    assert "camera.main.serial" in said


def test_swapped_focal_lengths(calibrate: Calibrate) -> None:
    said = calibrate(
        same,
        same,
        ("focal_length_mm = 800.0", "focal_length_mm = 1"),
        ("focal_length_mm = 6.0", "focal_length_mm = 800.0"),
        ("focal_length_mm = 1\n", "focal_length_mm = 6.0\n"),
    )
    assert "camera.main.focal_length_mm" in said
    assert "exchange them" in said
    assert "metres" not in said


def test_capture_before_calibrating_says_what_it_sees(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    given = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    text = ctl(*given, "capture").out
    assert "no_calibration" in text
    assert "seen         5 discs" in text
    assert "dcam-ctl calibrate --intrinsics" in text
    look = json.loads(ctl(*given, "capture", "--json").out)
    assert look["seen"]["corners"] > 120
    assert look["problems"] == []


@pytest.mark.parametrize("command", [("capture",), ("check", "--hardware")])
def test_capture_and_check_explain_what_is_not_recognised(
    ctl: Ctl, whole: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    """Cameras of which one is reversed; there is no calibration yet."""
    frames = Path(shutil.copytree(whole / "set", tmp_path / "set"))
    (row,) = read_frame_set(frames).rows_of("measure")
    image = read_image(frames / str(row.main))
    pixels = np.ascontiguousarray(mirrored(image.pixels))
    (frames / str(row.main)).write_bytes(encode_png(pixels, image.bits))
    text = (whole / "dcam.toml").read_text().replace("width_px", 'backend = "replay"\nwidth_px')
    (tmp_path / "dcam.toml").write_text(f'{text}\n[replay]\ndirectory = "{frames}"\n')
    given = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    said = ctl(*given, *command).out
    assert "main target" in said
    assert "the image is mirrored" in said
