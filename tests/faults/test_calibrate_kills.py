"""`calibrate --pan-tilt` killed at one moment after the other: then it ends well."""

import random
import signal
from pathlib import Path
from subprocess import PIPE

from benchmarks.soak_history import SITE
from daemon.store.database import open_store_readonly
from drivers.frameset import read_frame_set
from drivers.sim.head_angles import AnglesAsker
from tests.drivers.heads.test_head_programs import simulated_head
from tests.exhaustive import one_of
from tests.programs import Program
from tests.waiting import wait_for

KILLS, SEED = 10 // one_of(3), 5
REFERENCE_FILES = 20
"""Lens views and the zero with its repetitions are about so many images."""
SITE_WITH_HEAD = """
[simulation]
head_angles = "{0}/angles"
[pan_tilt]
backend = "pelco-d"
port = "{0}/head"
"""


def files_below(state: Path) -> int:
    """How far it has come: each view is two images and a line of its table."""
    return sum(1 for _ in state.glob("calibrations/*/*.png"))


def start(directory: Path) -> Program:
    where = ("--config", directory / "dcam.toml", "--state", directory / "state")
    return Program("daemon.ctl", *where, "calibrate", "--pan-tilt", "--accept", stderr=PIPE)


def killed_after(directory: Path, files: int) -> str:
    """Kill it when so many new images are there, or just before; give what was said at the end."""
    begun = files_below(directory / "state")
    with start(directory) as program:
        wait_for(
            lambda: files_below(directory / "state") >= begun + files or program.poll() is not None,
            f"{files} images more",
        )
        assert program.poll() is None, program.stderr.read()
        program.kill()
        said = program.stderr.read()  # the guard has the other end of it: it has done its work
    assert program.returncode == -signal.SIGKILL
    return said


def test_killed_again_and_again(tmp_path: Path) -> None:
    """Each time the head rests and nothing is active; in the end all is in one session."""
    draw = random.Random(SEED)
    (tmp_path / "dcam.toml").write_text(SITE.read_text() + SITE_WITH_HEAD.format(tmp_path))
    state = tmp_path / "state"
    with simulated_head(tmp_path, "--protocol", "pelco-d", "--speed-factor", "20"):
        ask = AnglesAsker(tmp_path / "angles")
        halted = 0
        for kill in range(KILLS):
            # The second one is when it has its zero: from then on a session can be taken up.
            files = draw.randint(0, 4) + (REFERENCE_FILES if kill == 1 else 0)
            halted += "the head was halted" in killed_after(tmp_path, files)
            stopped = ask()
            assert [ask() for _ in range(20)] == [stopped] * 20
            if (state / "dcam.db").exists():
                with open_store_readonly(state) as store:
                    assert store.active_calibration() is None
        kept = files_below(state)
        with start(tmp_path) as program:
            said = program.stderr.read()
        assert program.returncode == 0, said
        assert "continuing" in said
    assert halted > 0
    with open_store_readonly(state) as store:
        assert [record.id for record in store.calibrations()] == [1]
        active = store.active_calibration()
    assert active is not None
    assert active.report.passed
    frames = read_frame_set(Path(str(active.frames)))
    assert len(frames.rows_of("rig")) >= 21
    assert files_below(state) > kept > 0
