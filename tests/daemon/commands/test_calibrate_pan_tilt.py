"""`calibrate --pan-tilt`: where it turns the head, how it settles, and the views that it keeps."""

import re
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from core.discs.disc_finder import find_discs
from core.errors import CalibrationError
from core.images import GreyImage
from daemon.calibration.positions import VIEWS, ZERO, Limits, planned_positions
from daemon.calibration.session import FOLDER, serials_of, take_views, unfinished
from daemon.calibration.view_check import SETTLE_TIMEOUT_S, STILL_PX
from daemon.config.reading import load_config
from daemon.errors import HardwareError
from daemon.readings.sampler import open_sampler
from daemon.slots.exposure import loop_of
from drivers.frameset import read_frame_set
from drivers.protocols import CapturedFrame, CapturedPair
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.daemon.commands.conftest import SMALL
from tests.daemon.commands.watched import BEGIN, HASH, take, watched


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "dcam.toml"
    path.write_text(SMALL)
    return path


def covered(pair: CapturedPair) -> CapturedPair:
    """The pair with a leaf before the main target."""
    pixels = pair.main.pixels.copy()
    pixels[:, : pixels.shape[1] // 2] = 40
    return replace(pair, main=replace(pair.main, pixels=pixels))


def moving_board_px(frames: Path, world: World) -> list[float]:
    """How far each kept rig view is from where the head's position says that the board is."""
    away = []
    for row in read_frame_set(frames).rows_of("rig"):
        world.turn_head(row.pan_deg, row.tilt_deg)
        true = world.disc_centres_px(BEGIN)
        site = world.site
        image = read_frame_set(frames).read(row.main)
        seen = find_discs(image, site.main_target, site.nominal_px_per_mm)
        away.append(float(np.abs(seen.points_px - true).max()))
    return away


# ------------------------------------------------------------------------------- positions


def test_planned_positions_keep_the_target_in_the_image(config: Path) -> None:
    """21 and the zero twice, spread over both axes, none at which a disc leaves the image."""
    site = load_config(config).site()
    world = World(site, SimSettings(seed=1))
    image = GreyImage(world.render("main", BEGIN))
    discs = find_discs(image, site.main_target, site.nominal_px_per_mm)
    positions = planned_positions(site, discs, Limits(5.0, 5.0))
    assert len(positions) == VIEWS
    assert len(set(positions)) == 21
    assert positions.count(ZERO) == 3  # the grid's own middle is one of them
    radius_px = 0.5 * site.main_target.diameters_mm.max() * site.main.focal_px / 11000.0
    for position in positions:
        world.turn_head(*position)
        centres_px = world.disc_centres_px(BEGIN)
        assert centres_px.min() > radius_px
        assert (centres_px < np.array([320, 200]) - radius_px).all()
    assert np.ptp([pan for pan, _ in positions]) > 0.3
    assert np.ptp([tilt for _, tilt in positions]) > 0.15
    order = np.arange(len(positions))
    for axis in (0, 1):
        angles = np.array(positions)[:, axis]
        assert abs(np.corrcoef(order, angles)[0, 1]) < 0.75  # no drift looks like an angle


def test_the_light_is_settled_first_and_then_left_alone(config: Path, tmp_path: Path) -> None:
    """From a start ten times too short; also when the session is taken up again."""
    text = config.read_text() + '[exposure]\nmode = "auto"\nmain_us = 400.0\nsub_us = 500.0\n'
    config.write_text(text)
    made = watched(config)
    made.devices = replace(made.devices, exposure=loop_of(load_config(config)))
    pairs: list[tuple[int, CapturedPair]] = []

    def interrupt(_number: int, pair: CapturedPair) -> CapturedPair:
        pairs.append((len(made.exposures), pair))
        if len(made.moves) == 4:
            raise KeyboardInterrupt
        return pair

    made.spoil = interrupt
    with pytest.raises(KeyboardInterrupt):
        take(made, tmp_path)
    begun = unfinished(tmp_path, HASH)
    assert begun is not None
    settled = {role: (exposure_us, db) for role, exposure_us, db in made.exposures}
    assert begun.plan.exposures == settled
    looks = [pair for settled_cameras, pair in pairs if settled_cameras == len(made.exposures)]
    assert len(looks) > 5
    for pair in looks:
        assert (pair.main.exposure_us, pair.main.gain_db) == settled["main"]
        assert (pair.sub.exposure_us, pair.sub.gain_db) == settled["sub"]
        assert 3000.0 < min(pair.main.exposure_us, pair.sub.exposure_us) < 6500.0
    again = watched(config)
    again.devices = replace(
        again.devices, clock=made.devices.clock, exposure=loop_of(load_config(config))
    )
    again.spoil = interrupt
    made.moves[4:] = []
    with pytest.raises(KeyboardInterrupt):
        take(again, tmp_path, begun)
    assert {role: (us, db) for role, us, db in again.exposures} == settled


def test_a_target_at_the_edge_of_its_image_is_reported_before_anything_moves(config: Path) -> None:
    site = load_config(config).site()
    world = World(site, SimSettings(seed=1))
    image = GreyImage(world.render("main", BEGIN))
    discs = find_discs(image, site.main_target, site.nominal_px_per_mm)
    aside = replace(discs, points_px=discs.points_px - discs.points_px.min(axis=0) + 25.0)
    with pytest.raises(CalibrationError, match="aim the main camera so that its target is in the"):
        planned_positions(site, aside, Limits(5.0, 5.0))
    with pytest.raises(CalibrationError, match="widen the head's limits"):
        planned_positions(site, discs, Limits(5.0, 0.01))


# ------------------------------------------------------------------------------- settling


def test_a_swinging_rig_is_waited_for(config: Path, tmp_path: Path) -> None:
    """After each move it swings by 0.05 deg, and less from look to look: no view is from then."""
    made = watched(config)
    made.swing = lambda since: (0.05 * 0.12**since, 0.0)
    session, troubles = take(made, tmp_path)
    assert troubles == []
    assert made.captures > 3 * VIEWS  # it was looked at again and again
    # What STILL_PX lets through is a thirtieth of the swing; the main image shows it best.
    assert max(moving_board_px(session.directory, made.world)) < 40 * STILL_PX
    assert made.moves[-1] == ZERO


def test_a_rig_that_never_rests_ends_with_the_head_halted(config: Path, tmp_path: Path) -> None:
    made = watched(config)
    made.swing = lambda since: (0.02 * (-1) ** since, 0.0)
    with pytest.raises(HardwareError, match="does not come to rest: after 30 s"):
        take(made, tmp_path)
    assert made.halted == 1
    assert made.captures < SETTLE_TIMEOUT_S + 2


# ------------------------------------------------------------------------------- the views


def test_nothing_is_begun_while_a_target_is_not_well_seen(config: Path, tmp_path: Path) -> None:
    made = watched(config)
    made.spoil = lambda _number, pair: covered(pair)
    with pytest.raises(CalibrationError, match="before calibrating: main target"):
        take(made, tmp_path)
    assert not (tmp_path / FOLDER).exists()
    assert made.halted == 1


def test_a_dark_board_is_reported_with_what_to_do(config: Path, tmp_path: Path) -> None:
    made = watched(config)

    def darker(_number: int, pair: CapturedPair) -> CapturedPair:
        dark: CapturedFrame = replace(pair.sub, pixels=pair.sub.pixels // 9)
        return replace(pair, sub=dark)

    made.spoil = darker
    with pytest.raises(CalibrationError, match=r"more light, or a longer \[exposure\] sub_us"):
        take(made, tmp_path)


def test_lens_views_are_taken_over_from_another_frame_set(
    config: Path, bench: Path, tmp_path: Path
) -> None:
    """The board was in the hand days before: its views stand in the set like its own."""
    made = watched(config)
    given = read_frame_set(bench / "set")

    def stop(number: int, pair: CapturedPair) -> CapturedPair:
        if number == 6:
            raise KeyboardInterrupt
        return pair

    made.spoil = stop
    with pytest.raises(KeyboardInterrupt):
        take(made, tmp_path, lens=given)
    (directory,) = (tmp_path / FOLDER).iterdir()
    kept = read_frame_set(directory)
    for old, new in zip(given.rows_of("intrinsics"), kept.rows_of("intrinsics"), strict=True):
        assert (directory / new.sub).read_bytes() == (given.directory / old.sub).read_bytes()
        assert new.slot_utc == old.slot_utc


def test_sensors_are_read_at_the_zero_and_one_that_fails_costs_its_value_only(
    config: Path, tmp_path: Path
) -> None:
    sensor = tmp_path / "sensor"
    sensor.write_text("12500\n")
    config.write_text(
        f'{config.read_text()}\n[[reading]]\nname = "air"\nunit = "degC"\nfile = "{sensor}"\n'
        'scale = 0.001\n[[reading]]\nname = "steel"\nunit = "degC"\n'
        'command = ["sleep", "60"]\ntimeout_s = 0.2\n'
    )
    made = watched(config)
    sampler = open_sampler(load_config(config))
    made.devices = replace(made.devices, sampler=sampler, serials={"main": "100"})

    def interrupt(_number: int, pair: CapturedPair) -> CapturedPair:
        if len(made.moves) > 1:
            raise KeyboardInterrupt
        return pair

    made.spoil = interrupt
    troubles: list[str] = []
    with pytest.raises(KeyboardInterrupt), closing(sampler):
        take_views(made.devices, tmp_path, HASH, None, None, lambda _step: None, troubles.append)
    (trouble,) = troubles
    assert trouble.startswith('zero: reading "steel": ')
    (directory,) = (tmp_path / FOLDER).iterdir()
    (zero,) = read_frame_set(directory).rows_of("reference")
    assert dict(zero.readings) == {"air": 12.5}
    assert serials_of(directory) == {"main": "100"}


def test_the_zero_is_the_mean_of_its_clear_looks(config: Path, tmp_path: Path) -> None:
    """A leaf passes in two looks and the rig is bumped in a third: five are left, in 16 bits."""
    made = watched(config)

    def spoil(number: int, pair: CapturedPair) -> CapturedPair:
        if len(made.moves) > 1:
            raise KeyboardInterrupt
        if number in (6, 7):
            return covered(pair)
        if number == 9:  # by a pixel: the sub-camera sees the board elsewhere
            shifted = np.roll(pair.sub.pixels, 1, axis=1)
            return replace(pair, sub=replace(pair.sub, pixels=shifted))
        return pair

    made.spoil = spoil
    troubles: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        take_views(made.devices, tmp_path, HASH, None, None, lambda _step: None, troubles.append)
    (trouble,) = troubles
    assert re.fullmatch("zero: 3 of 8 looks left out, .* the zero is the mean of 5", trouble)
    (directory,) = (tmp_path / FOLDER).iterdir()
    frames = read_frame_set(directory)
    (zero,) = frames.rows_of("reference")
    made.world.turn_head(*ZERO)
    for role, name in (("main", zero.main), ("sub", zero.sub)):
        mean = frames.read(name)
        assert (mean.bits, mean.pixels.dtype) == (16, np.uint16)
        one = made.world.render(role, zero.slot_utc).astype(float)
        other = made.world.render(role, zero.slot_utc - timedelta(seconds=60)).astype(float)
        noise_dn = np.std(one - other) / np.sqrt(2.0)
        away = mean.pixels / 257.0 - one  # of the mean itself and of a single image
        assert np.std(away) < 1.2 * noise_dn * np.sqrt(1.0 + 1.0 / 5.0)
        assert np.abs(away).max() < 8.0 * noise_dn + 1.0


def test_a_position_with_a_covered_target_is_taken_again(config: Path, tmp_path: Path) -> None:
    made = watched(config)
    made.spoil = lambda _number, pair: covered(pair) if len(made.moves) == 9 else pair
    session, troubles = take(made, tmp_path)
    assert len(troubles) == 1
    assert "main target" in troubles[0]
    assert "taken again" in troubles[0]
    steps = [int(row.extra["step"]) for row in session.rows if row.role == "rig"]
    assert len(steps) == VIEWS + 1
    assert set(steps) == set(range(VIEWS))
    kept = read_frame_set(session.directory).rows_of("reference", "rig")
    assert {row.main_temperature_c is None for row in kept} == {False}
    assert {row.sub_temperature_c is None for row in kept} == {False}
