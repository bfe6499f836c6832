"""The simulated head as a program of its own, driven by dcam-ctl through its serial port."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest

from benchmarks.soak_history import SITE
from daemon.ctl import cli
from daemon.error_report import run
from daemon.store.database import open_store_readonly
from drivers.errors import DeviceError
from drivers.frameset import read_frame_set
from drivers.heads.serial_line import SerialLine
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.head_angles import AnglesAsker
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.drivers.sim.rigs import site
from tests.exhaustive import IS_ASKED
from tests.programs import Program
from tests.waiting import PATIENCE_S, wait_for


@contextmanager
def simulated_head(directory: Path, *options: str) -> Iterator[Program]:
    """`dcam-ctl simulate head`, its port linked as `head` in the directory."""
    places = ("--link", directory / "head", "--angles", directory / "angles")
    with Program("daemon.ctl", "simulate", "head", *options, *places, stdout=PIPE) as process:
        try:
            assert process.stdout.readline().strip() == str(directory / "head")
            yield process
        finally:
            process.terminate()


def configured(directory: Path, pan_tilt: str) -> list[str]:
    """A simulated site whose head is at the port; the arguments that name it."""
    config = directory / "dcam.toml"
    simulation = f'[simulation]\nhead_angles = "{directory}/angles"'
    limit = "[quality]\nmax_sigma_mm = 1.0"  # a sensor of few pixels: 0.35 mm expected
    head = f'[pan_tilt]\nport = "{directory}/head"\n{pan_tilt}'
    config.write_text(f"{SITE.read_text()}\n{limit}\n{simulation}\n{head}\n")
    return ["--config", str(config), "--state", str(directory / "state")]


KINDS = {
    "ptu": (
        ["--protocol", "ptu", "--speed-factor", "20"],
        'backend = "ptu"\nhome_deg = [2.0, -1.0]',
    ),
    "pelco-d": (["--protocol", "pelco-d", "--speed-factor", "20"], 'backend = "pelco-d"'),
    # Moved by time, so in its own: a degree a second at the lowest of 63 levels.
    "pelco-d without answers": (
        ["--protocol", "pelco-d", "--no-feedback", "--speed", "63"],
        'backend = "pelco-d"\nreports_position = false\nspeed_deg_s = 1.0',
    ),
}
"""Options of the simulated head, and how the site's config names it."""
TRIED = [kind for kind in KINDS if IS_ASKED or kind != "pelco-d"]
"""With answers Pelco-D goes the way of the other that answers."""


@pytest.mark.parametrize("kind", TRIED)
def test_calibrate_through_the_port_to_a_stored_calibration(kind: str, tmp_path: Path) -> None:
    options, pan_tilt = KINDS[kind]
    arguments = configured(tmp_path, pan_tilt)
    with simulated_head(tmp_path, *options):
        code = run(cli, "dcam-ctl", [*arguments, "calibrate", "--pan-tilt", "--accept"])
        assert code == 0
        ask = AnglesAsker(tmp_path / "angles")
        at_the_end = ask()
        assert [ask() for _ in range(20)] == [at_the_end] * 20
    if "without" not in kind:  # by time it comes as near as a loaded machine sends its orders
        home = (2.0, -1.0) if kind == "ptu" else (0.0, 0.0)
        assert at_the_end == pytest.approx(home, abs=0.01)
    with open_store_readonly(tmp_path / "state") as store:
        record = store.active_calibration()
    assert record is not None
    assert record.report.passed
    rows = read_frame_set(Path(str(record.frames))).rows_of("rig")
    assert len(rows) >= 21
    assert np.ptp([row.pan_deg for row in rows]) > 0.2


def test_check_asks_the_head_and_moves_nothing(tmp_path: Path, capfd) -> None:
    arguments = configured(tmp_path, 'backend = "ptu"')
    with simulated_head(tmp_path, "--protocol", "ptu"):
        assert run(cli, "dcam-ctl", [*arguments, "check", "--hardware"]) == 0
        assert AnglesAsker(tmp_path / "angles")() == (0.0, 0.0)
    said = capfd.readouterr().out
    assert "Pan-Tilt Controller" in said
    assert "pan 0.000 tilt 0.000 deg, home is 0 0" in said
    assert "-159.0 to 159.0" in said
    assert "24.9 V" in said


def test_check_without_the_head_says_what_to_do(tmp_path: Path, capfd) -> None:
    arguments = configured(tmp_path, 'backend = "ptu"')
    assert run(cli, "dcam-ctl", [*arguments, "check", "--hardware"]) == 4
    assert "no such port; check cable and power" in capfd.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_program_ends_cleanly_and_takes_its_names_away(number: int, tmp_path: Path) -> None:
    with simulated_head(tmp_path, "--protocol", "pelco-d") as process:
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == 0
    assert not os.path.lexists(tmp_path / "head")
    assert not os.path.lexists(tmp_path / "angles")


@pytest.mark.parametrize("option", ["--link", "--angles"])
@pytest.mark.parametrize("name", ["notes.txt", "no-such-folder/head"])
def test_a_name_that_is_not_its_own_is_left_alone(
    tmp_path: Path, capfd, option: str, name: str
) -> None:
    notes, asked = tmp_path / "notes.txt", str(tmp_path / name)
    notes.write_text("not a head")
    command = ["simulate", "head", "--protocol", "ptu", option, asked]
    assert run(cli, "dcam-ctl", command) == 2
    (reported,) = capfd.readouterr().err.splitlines()
    assert reported.startswith(f"dcam-ctl: error: {option} {asked}: ")
    assert notes.read_text() == "not a head"


def test_the_names_of_a_head_that_was_killed_are_taken_over(tmp_path: Path) -> None:
    with simulated_head(tmp_path, "--protocol", "ptu") as process:
        process.kill()
        process.wait()
        assert os.path.lexists(tmp_path / "head")
        with simulated_head(tmp_path, "--protocol", "pelco-d"):
            assert AnglesAsker(tmp_path / "angles")() == (0.0, 0.0)


def test_a_frame_taken_on_the_way_shows_where_the_head_was_then(tmp_path: Path) -> None:
    """Triggered on the way, fetched further on: the image is that of the trigger."""
    now = datetime(2026, 3, 1, tzinfo=UTC)

    class Still:
        def now_utc(self) -> datetime:
            return now

        def monotonic_s(self) -> float:
            return 0.0

    world = World(site(), SimSettings(scenarios=()))
    camera = SimulatedCamera(world, "sub", Still())
    with simulated_head(tmp_path, "--protocol", "ptu"):
        asker, reported = AnglesAsker(tmp_path / "angles"), []

        def remembered() -> tuple[float, float]:
            reported.append(asker())
            return reported[-1]

        world.follow_head(remembered)
        line = SerialLine(str(tmp_path / "head"), 9600)
        line.open()
        line.write(b"PS16 PP155 ")  # one degree, at 0.1 deg/s: a busy computer is not too late
        wait_for(lambda: asker()[0] > 0.05, "the head to move")
        camera.open()
        camera.arm()
        camera.trigger()
        then = reported[-1]
        wait_for(lambda: asker()[0] > then[0] + 0.1, "the head to move on")
        later = asker()
        shown = camera.fetch(1.0).pixels
        line.close()
    np.testing.assert_array_equal(shown, world.render("sub", now, then))
    assert not np.array_equal(shown, world.render("sub", now, later))


def test_a_simulated_rig_without_its_head_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="run dcam-ctl simulate head --angles"):
        AnglesAsker(tmp_path / "nothing")()
