"""`calibrate --pan-tilt` that breaks off: nothing is half made, and it goes on where it ended."""

import json
import os
import signal
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from subprocess import PIPE
from threading import Event

import pytest

from daemon.calibration.positions import VIEWS
from daemon.calibration.session import FOLDER, take_views, unfinished
from daemon.commands import calibrate_head
from daemon.store.database import open_store_readonly
from drivers.protocols import CapturedPair
from tests.daemon.commands.conftest import SMALL, Ctl
from tests.daemon.commands.watched import HASH, take, watched
from tests.exhaustive import one_of
from tests.programs import Program, traced
from tests.waiting import wait_for


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "dcam.toml"
    path.write_text(SMALL)
    return path


@pytest.mark.parametrize("at", [45, 12][:: one_of(2)])
def test_an_interrupted_session_goes_on_where_it_broke_off(
    config: Path, tmp_path: Path, at: int
) -> None:
    """Whatever breaks off: the head is halted, the views are kept, none is taken twice."""
    made = watched(config)

    def interrupt(number: int, pair: CapturedPair) -> CapturedPair:
        if number == at:
            raise KeyboardInterrupt
        return pair

    made.spoil = interrupt
    with pytest.raises(KeyboardInterrupt):
        take(made, tmp_path)
    assert made.halted == 1
    begun = unfinished(tmp_path, HASH)
    assert begun is not None
    kept = list(begun.rows)
    made.devices.clock.wait_until(kept[-1].slot_utc + timedelta(minutes=1), Event())
    again = watched(config)
    again.devices = replace(again.devices, clock=made.devices.clock)
    session, _ = take(again, tmp_path, begun)
    assert session.directory == begun.directory
    assert session.rows[: len(kept)] == kept
    steps = [int(row.extra["step"]) for row in session.rows if row.role == "rig"]
    assert sorted(steps) == list(range(VIEWS + 1))  # and the zero once more, after the break
    assert unfinished(tmp_path, HASH) is None


def test_only_a_young_session_of_the_same_config_is_taken_up(config: Path, tmp_path: Path) -> None:
    made = watched(config)

    def interrupt(number: int, pair: CapturedPair) -> CapturedPair:
        if number == 20:
            raise KeyboardInterrupt
        return pair

    made.spoil = interrupt
    with pytest.raises(KeyboardInterrupt):
        take(made, tmp_path)
    last_utc = unfinished(tmp_path, HASH).rows[-1].slot_utc
    assert unfinished(tmp_path, "another config") is None
    assert unfinished(tmp_path, HASH, last_utc + timedelta(hours=2)) is not None
    assert unfinished(tmp_path, HASH, last_utc + timedelta(hours=4)) is None


def test_killed_at_any_moment_nothing_is_half_made(
    config: Path, ctl: Ctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL by the kernel at chosen syncs of the program, then the same command again."""
    state = tmp_path / "state"
    arguments = ["--config", str(config), "--state", str(state), "calibrate", "--pan-tilt"]
    for nth in (20, 90):
        kill = ("-e", "trace=fsync", "-e", f"inject=fsync:signal=KILL:when={nth}")
        said = tmp_path / "said"
        code = traced(("-o", os.devnull, *kill), "daemon.ctl", *arguments, stderr=said)
        assert code == -signal.SIGKILL, said.read_text()
        if (state / "dcam.db").exists():
            with open_store_readonly(state) as store:
                assert store.active_calibration() is None
    taken = []
    monkeypatch.setattr(
        calibrate_head, "take_views", lambda *a: taken.append(a[4]) or take_views(*a)
    )
    ran = ctl(*arguments, "--json")
    assert ran.code == 0, ran.err
    assert taken[0] is not None
    assert "continuing" in ran.err
    result = json.loads(ran.out)
    assert result["passed"]
    assert result["active"]
    # One that was killed before its zero is left as it is; all else is in one session.
    assert len(list((state / FOLDER).iterdir())) == 2


def test_sigterm_halts_and_says_how_to_go_on(config: Path, tmp_path: Path) -> None:
    state = tmp_path / "state"
    words = ("--config", config, "--state", state, "calibrate", "--pan-tilt")
    with Program("daemon.ctl", *words, stderr=PIPE) as program:
        wait_for(
            lambda: program.poll() is not None or bool(list(state.glob(f"{FOLDER}/*/frames.csv"))),
            "a view",
        )
        program.send_signal(signal.SIGTERM)
        err = program.stderr.read()
        assert program.wait() == 1
    assert "interrupted; the views are kept, the same command continues from there" in err
    assert sum("error" in line for line in err.splitlines()) == 1
    assert "Traceback" not in err
