"""`calibrate --intrinsics`: says what to show next, keeps what is of use, and when it is enough."""

import itertools
import json
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from subprocess import PIPE

import cv2
import numpy as np
import pytest

from core.geometry.pose import Pose
from core.lens.lens_coverage import COLUMNS, ENOUGH_VIEWS, ROWS, lens_coverage
from core.site import CameraGeometry, Site
from daemon.calibration.lens_session import Bench, latest_lens_views, take_lens_views
from daemon.calibration.session import FOLDER, CalibrationDevices, Session, take_views
from daemon.calibration.view_check import see_board
from daemon.commands import calibrate_head, demo
from daemon.config.reading import load_config
from drivers.frameset import encode_png, read_frame_set, read_image, write_table
from drivers.protocols import CapturedFrame, CapturedPair, Image
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.daemon.commands.conftest import SEED, SMALL, Ctl, Ran
from tests.daemon.commands.watched import Watched, watched
from tests.programs import Program, ran
from tests.waiting import wait_for

CAMERA = CameraGeometry(width_px=600, height_px=400, pixel_pitch_um=5.86, focal_length_mm=6.0)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "dcam.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ran]:
    """A state with lens views taken until they were enough, and what was said; not to be changed.

    Its config is beside it.
    """
    directory = tmp_path_factory.mktemp("lens-views")
    config = directory / "dcam.toml"
    config.write_text(SMALL)
    words = ["--config", config, "--state", directory / "state", "calibrate", "--intrinsics"]
    done = ran("daemon.ctl", *words)
    return directory / "state", Ran(done.returncode, done.stdout, done.stderr)


@pytest.fixture
def state(taken: tuple[Path, Ran], tmp_path: Path) -> Path:
    """A copy of the state with lens views, which a test may change."""
    return Path(shutil.copytree(taken[0], tmp_path / "state"))


def tilted(about: str, deg: float) -> Pose:
    axis = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0]}[about]
    return Pose.from_vectors(np.radians(deg) * np.array(axis), np.array([0.0, 0.0, 50.0]))


EVERYWHERE = np.array(
    [
        [(i + 0.5) * 600 / COLUMNS, (j + 0.5) * 400 / ROWS]
        for i in range(COLUMNS)
        for j in range(ROWS)
    ]
)
ALL_WAYS = [tilted(about, deg) for about in "xy" for deg in (20.0, 20.0, -20.0, -20.0)]


@pytest.mark.parametrize(
    ("missing", "asked"),
    [
        # About y by +20 deg the board's x axis comes nearer: its left side is the far one.
        (tilted("y", 20.0), "the left away from the camera"),
        (tilted("y", -20.0), "the right away from the camera"),
        (tilted("x", 20.0), "the bottom away from the camera"),
        (tilted("x", -20.0), "the top away from the camera"),
    ],
)
def test_the_tilt_that_is_missing_is_asked_for(missing: Pose, asked: str) -> None:
    poses = [pose for pose in ALL_WAYS if not np.allclose(pose.R, missing.R)]
    far = missing.apply(np.array([[30.0, 0, 0], [-30.0, 0, 0], [0, 30.0, 0], [0, -30.0, 0]]))
    sides = ["the right", "the left", "the bottom", "the top"]
    assert sides[int(far[:, 2].argmax())] in asked  # the words mean what they say
    suggestions = lens_coverage([EVERYWHERE] * len(poses), poses, CAMERA).suggestions
    assert len(suggestions) == 1
    assert asked in suggestions[0]


@pytest.mark.parametrize(
    ("keep", "asked"),
    [
        (EVERYWHERE[:, 0] < 400, "centre right"),
        (EVERYWHERE[:, 0] > 200, "centre left"),
        ((EVERYWHERE[:, 0] < 400) | (EVERYWHERE[:, 1] > 140), "top right"),
    ],
)
def test_the_part_of_the_image_that_is_missing_is_asked_for(keep: np.ndarray, asked: str) -> None:
    suggestions = lens_coverage(
        [EVERYWHERE[keep]] * 12, [*ALL_WAYS, *ALL_WAYS[:4]], CAMERA
    ).suggestions
    assert len(suggestions) == 1
    assert f"to the {asked} of the sub image" in suggestions[0]


def test_when_all_is_covered_only_the_number_counts() -> None:
    poses = [*ALL_WAYS, *ALL_WAYS]
    for number in range(8, ENOUGH_VIEWS + 1):
        suggestions = lens_coverage([EVERYWHERE] * number, poses[:number], CAMERA).suggestions
        assert bool(suggestions) == (number < ENOUGH_VIEWS)


def test_it_goes_on_until_the_views_are_enough_and_says_so(
    ctl: Ctl, config: Path, taken: tuple[Path, Ran]
) -> None:
    state, ran = taken
    assert ran.code == 0, ran.err
    assert ran.out.startswith("lens views are enough\n")
    reported = [line for line in ran.err.splitlines() if line.startswith("dcam-ctl: view")]
    assert all("; next: " in line for line in reported[:-1])
    assert reported[-1].endswith("; enough")
    frames = latest_lens_views(state)
    assert len(frames.rows) == len(reported) >= ENOUGH_VIEWS
    assert str(frames.directory) in ran.out
    judged = ctl(
        "--config", config, "calibrate", "--intrinsics", "--from", frames.directory, "--json"
    )
    assert judged.code == 0
    result = json.loads(judged.out)
    assert result["enough"]
    true_focal_px = 6000.0 / 35.16  # the rig as built is within 1.5 % of the drawing
    assert result["lens"]["alpha"] == pytest.approx(true_focal_px, rel=0.015)
    assert result["lens_sigma"][0] < 0.002 * true_focal_px


def test_too_few_views_are_reported_with_what_is_missing(
    ctl: Ctl, bench: Path, tmp_path: Path
) -> None:
    """Of a set's lens views all but four are gone, and one image is damaged."""
    shutil.copytree(bench / "set", tmp_path / "set")
    lens = read_frame_set(tmp_path / "set").rows_of("intrinsics")[:5]
    write_table(tmp_path / "set", lens)
    (tmp_path / "set" / lens[4].sub).write_bytes(b"no image")
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", tmp_path / "state"),
        *("calibrate", "--intrinsics", "--from", tmp_path / "set"),
    )
    assert ran.code == 1
    first, second, third, *_ = ran.out.splitlines()
    assert first.startswith("lens views are NOT enough; ")
    assert second.startswith("4 views used, 1 left out")
    assert lens[4].sub in third
    use = f"calibrate --pan-tilt --lens-views {tmp_path / 'set'} uses them"
    assert use in ran.out


def test_views_that_are_all_mirrored_are_said_to_be_perhaps(
    ctl: Ctl, config: Path, state: Path
) -> None:
    """The colours of this board of 10 x 10 squares look turned then, as if it was held so."""
    frames = latest_lens_views(state)
    words = ("--config", config, "calibrate", "--intrinsics", "--from", frames.directory)
    assert "warning" not in ctl(*words).out
    for row in frames.rows:
        image = read_image(frames.directory / row.sub)
        mirrored = np.ascontiguousarray(image.pixels[:, ::-1])
        (frames.directory / row.sub).write_bytes(encode_png(mirrored, image.bits))
    (warning,) = [line for line in ctl(*words).out.splitlines() if line.startswith("warning: ")]
    assert "all views show the board turned by 90 degrees; if it was held upright" in warning
    assert "the images are mirrored or turned" in warning
    assert "ReverseX" in warning


@pytest.fixture
def held(config: Path) -> Watched:
    made = watched(config)
    made.move_to(0.0, 0.0)
    made.devices = replace(made.devices, hold_board=made.world.hold_board)
    return made


def interrupted_at(look: int) -> Callable[[int, CapturedPair], CapturedPair]:
    """All is as it is until this look."""

    def spoil(number: int, pair: CapturedPair) -> CapturedPair:
        if number == look:
            raise KeyboardInterrupt
        return pair

    return spoil


def bench_of(held: Watched) -> Bench:
    rig = held.devices
    return Bench(rig.site, rig.source, rig.clock, rig.hold_board)


def test_a_board_that_is_not_moved_on_is_kept_once(held: Watched, tmp_path: Path) -> None:
    held.devices = replace(
        held.devices, hold_board=lambda number: held.world.hold_board((number or 0) // 3)
    )
    held.spoil = interrupted_at(10)
    said: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        take_lens_views(bench_of(held), tmp_path, lambda _covered, text: said.append(text))
    (directory,) = (tmp_path / FOLDER).iterdir()
    assert said[0] == "view 1 kept"
    assert said[1] == said[2] == "not kept: as the view before; hold the board another way"
    assert said[3] == "view 2 kept"
    assert len(read_frame_set(directory).rows) == sum("kept" in t and "not" not in t for t in said)


def test_a_moving_or_covered_board_is_not_kept(held: Watched, tmp_path: Path) -> None:
    """At the first pose the board shakes, at the second a hand is before it."""

    def spoil(_number: int, pair: CapturedPair) -> CapturedPair:
        interrupted_at(40)(held.captures, pair)  # thirty are of the board that shakes
        pixels = pair.sub.pixels.copy()
        if pose == [0]:
            shift_px = 5 * (held.captures % 2)
            pixels = np.roll(pixels, shift_px, axis=1)
        if pose == [1]:
            pixels[:, :225] = 90
        return replace(pair, sub=replace(pair.sub, pixels=pixels))

    pose: list[int] = []

    def hold(number: int | None) -> None:
        pose[:] = [] if number is None else [number]
        held.world.hold_board(number)

    held.spoil = spoil
    held.devices = replace(held.devices, hold_board=hold)
    said: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        take_lens_views(bench_of(held), tmp_path, lambda _covered, text: said.append(text))
    assert said[0] == "not kept: the board moves; hold it still"
    assert said[1].startswith("not kept: no checkerboard")
    assert said[2] == "view 1 kept"


@pytest.fixture(scope="module")
def full_size_board() -> tuple[Site, Image]:
    """A board in the hand as the demo's sub-camera sees it, sharp."""
    site = load_config(demo.SITE).site()
    world = World(site, SimSettings(seed=SEED))
    world.hold_board(2)
    return site, world.render("sub", datetime(2026, 2, 28, tzinfo=UTC))


@pytest.mark.parametrize(("blur_px", "kept"), [(2.0, True), (3.5, False)])
def test_a_blurred_board_is_not_kept(
    full_size_board: tuple[Site, Image], blur_px: float, kept: bool
) -> None:
    site, sharp = full_size_board
    blurred = cv2.GaussianBlur(sharp, (0, 0), blur_px)
    frame = CapturedFrame(blurred, 8, 1, 1, 0.0)
    problems = see_board(CapturedPair(frame, frame, 0.0), site).problems
    if kept:
        assert problems == ()
    else:
        (problem,) = problems
        assert problem.startswith("sub camera: edges are 3.")
        assert "focus the lens" in problem


def test_the_head_calibration_uses_the_latest_lens_views(
    ctl: Ctl, config: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its session is begun with them, before any other view."""
    taken = latest_lens_views(state)
    write_table(
        taken.directory, taken.rows[: ENOUGH_VIEWS + 1]
    )  # simulated, it takes another number
    lens = latest_lens_views(state)

    def interrupted(devices: CalibrationDevices, *more: object) -> Session:
        capture, stop, looks = devices.source.capture, interrupted_at(6), itertools.count(1)
        monkeypatch.setattr(
            devices.source, "capture", lambda slot_utc: stop(next(looks), capture(slot_utc))
        )
        return take_views(devices, *more)

    monkeypatch.setattr(calibrate_head, "take_views", interrupted)
    assert ctl("--config", config, "--state", state, "calibrate", "--pan-tilt").code == 1
    (directory,) = set((state / FOLDER).iterdir()) - {taken.directory}
    frames = read_frame_set(directory)
    assert len(frames.rows_of("intrinsics")) == len(lens.rows) == ENOUGH_VIEWS + 1


def test_lens_views_that_were_broken_off_do_not_replace_whole_ones(
    config: Path, state: Path
) -> None:
    """SIGTERM after the first view of a second session; it says that it will not go on."""
    arguments = ["--config", str(config), "--state", str(state)]
    whole = latest_lens_views(state)
    second = Path(f"{whole.directory}-2")
    with Program("daemon.ctl", *arguments, "calibrate", "--intrinsics", stderr=PIPE) as program:
        taken = second / "frames.csv"
        wait_for(lambda: program.poll() is not None or taken.exists(), "a view of the second")
        program.send_signal(signal.SIGTERM)
        err = program.stderr.read()
        assert program.wait() == 1
    assert err.splitlines()[-1].endswith("too few to be used; the same command starts again")
    assert read_frame_set(second).rows_of("intrinsics")
    assert latest_lens_views(state).directory == whole.directory


@pytest.mark.parametrize("option", ["--fresh", "--without-lens-views"])
def test_what_is_for_the_head_is_refused_with_the_board_in_the_hand(
    ctl: Ctl, config: Path, option: str
) -> None:
    ran = ctl("--config", config, "calibrate", "--intrinsics", option)
    assert ran.code == 2
    assert "go with --pan-tilt" in ran.err


def test_a_real_rig_without_lens_views_is_asked_to_take_them(ctl: Ctl, tmp_path: Path) -> None:
    config = tmp_path / "dcam.toml"
    text = SMALL.replace('"simulated"', '"aravis"')
    for serial in ("111", "222"):
        text = text.replace('"aravis"\nwidth', f'"aravis"\nserial = "{serial}"\nwidth', 1)
    config.write_text(text + '[pan_tilt]\nbackend = "ptu"\nport = "/dev/null"\n')
    ran = ctl("--config", config, "--state", tmp_path / "state", "calibrate", "--pan-tilt")
    assert ran.code == 2
    assert "dcam-ctl calibrate --intrinsics" in ran.err
