"""A head that is moved by time is halted even when the program that moves it is killed."""

import json
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE

import pytest

from tests.daemon.commands.conftest import SMALL
from tests.programs import Program
from tests.waiting import PATIENCE_S


@pytest.fixture
def head(tmp_path: Path) -> Iterator[Path]:
    """A simulated Pelco-D head that knows no positions; the socket that tells where it truly is."""
    angles = tmp_path / "angles"
    words = (
        *("simulate", "head", "--protocol", "pelco-d", "--no-feedback", "--speed", 0.2),
        *("--link", tmp_path / "head", "--angles", angles),
    )
    with Program("daemon.ctl", *words, stdout=PIPE) as program:
        program.stdout.readline()
        yield angles
        program.send_signal(signal.SIGTERM)


def where(angles: Path) -> tuple[float, float]:
    with socket.socket(socket.AF_UNIX) as asking:
        asking.connect(str(angles))
        reported = json.loads(asking.makefile().readline())
    return reported["pan_deg"], reported["tilt_deg"]


def until(angles: Path, moving: bool) -> tuple[float, float]:
    """Look every fifth of a second until the head moves, or until it does not any more."""
    last, end_s = where(angles), time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        time.sleep(0.2)
        now = where(angles)
        if (now != last) == moving:
            return now
        last = now
    pytest.fail("the head did not " + ("move" if moving else "stop"))


def test_sigkill_in_a_move_of_a_head_without_feedback(head: Path, tmp_path: Path) -> None:
    """It would turn on to its stop: it was asked to start, and nobody is left to say stop."""
    config = tmp_path / "dcam.toml"
    config.write_text(
        SMALL
        + f'head_angles = "{head}"\n[pan_tilt]\nbackend = "pelco-d"\nport = "{tmp_path / "head"}"\n'
        + "reports_position = false\nspeed_deg_s = 0.2\n"
    )
    words = ("--config", config, "--state", tmp_path / "s", "calibrate", "--pan-tilt")
    with Program("daemon.ctl", *words, stderr=PIPE) as program:
        until(head, moving=True)
        program.kill()
        begun = where(head)
        stopped = until(head, moving=False)
        reported = program.stderr.read()  # the guard has the other end of it: it is gone too
    assert abs(stopped[0] - begun[0]) + abs(stopped[1] - begun[1]) < 1.5
    assert "the head was halted, its program is gone" in reported
    assert where(head) == stopped
