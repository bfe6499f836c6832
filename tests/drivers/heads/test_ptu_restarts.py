"""The ASCII pan-tilt unit: what other programs have left in it, and what a restart is known by."""

from __future__ import annotations

import fcntl
import os
import pty
from dataclasses import replace

import pytest
from structlog.testing import capture_logs

from drivers.errors import HeadError, HeadLostError
from drivers.heads.ptu_ascii import PtuHead
from drivers.heads.serial_line import SerialLine
from drivers.sim.head_ptu import PtuMachine, PtuModel
from tests.drivers.heads.lines import SETTINGS, Recorder
from tests.drivers.heads.test_ptu import D46, head_on


@pytest.mark.parametrize(
    "left",
    [{"slaved": True}, {"velocity_control": True}, {"slaved": True, "modes": False}],
    ids=["slaved", "velocity control", "slaved, an older unit"],
)
def test_a_mode_that_another_program_left_does_not_keep_it_from_moving(left) -> None:
    head, line = head_on(PtuMachine(replace(D46, **left)))
    head.move_to(2.0, 1.0)
    assert line.machine.angles_deg(line.now_s) == pytest.approx((2.0, 1.0), abs=0.03)


def test_a_speed_of_zero_that_another_program_left_is_named() -> None:
    machine = PtuMachine(D46)
    machine.tilt.speed_deg_s = 0.0
    head, _ = head_on(machine)
    with pytest.raises(HeadError, match=r"speed is set to 0.* set pan_tilt.speed_deg_s"):
        head.move_to(1.0, 1.0)


class PowerCut(PtuMachine):
    """Loses power 0.3 s after a move began; silent while it homes, then its banner."""

    def __init__(self, model: PtuModel, home_s: float, banner: bytes) -> None:
        super().__init__(model)
        self._home_s, self._banner = home_s, banner
        self._cut_s: float | None = None
        self._up_s: float | None = None

    def receive(self, data: bytes, now_s: float) -> bytes:
        if self._is_off(now_s):
            return b""
        said = super().receive(data, now_s)
        if self._moves and self._cut_s is None:
            self._cut_s = now_s + 0.3
        return said

    def advance(self, now_s: float) -> bytes:
        if self._cut_s is not None and self._up_s is None and now_s > self._cut_s:
            self._up_s = now_s + self._home_s
            self._echo, self._verbose = True, True
            for axis in (self.pan, self.tilt):
                axis.speed_deg_s = 30.0
                axis.go(0.0, now_s)
        if self._is_off(now_s):
            return b""
        banner, self._banner = (
            (self._banner, b"") if self._up_s is not None else (b"", self._banner)
        )
        return banner + super().advance(now_s)

    def _is_off(self, now_s: float) -> bool:
        return self._up_s is not None and now_s < self._up_s


BANNER = b"\r\n### Pan-Tilt Controller v2.12 ###\r\n"
HOMED = b"!T!T!P!P*\r\n"


@pytest.mark.parametrize(
    ("home_s", "banner", "said"),
    [
        (0.2, BANNER + HOMED, "restarted in the middle of a move.* swung the rig"),
        (0.2, BANNER, "restarted in the middle of a move"),
        (0.2, HOMED, "restarted in the middle of a move"),
        (60.0, BANNER + HOMED, "no answer to .* switched on answers after its homing only"),
    ],
)
def test_a_power_cut_in_a_move_is_named_and_the_head_greeted_again(home_s, banner, said) -> None:
    machine = PowerCut(PtuModel(), home_s, banner)
    head, line = head_on(machine, speed_deg_s=1.0)
    with pytest.raises(HeadError, match=said) as error:
        head.move_to(4.0, 2.0)
    assert "limit switch" not in str(error.value)
    assert "nonsense" not in str(error.value)
    line.now_s += home_s
    head.move_to(1.0, 0.5)
    assert machine.pan.speed_deg_s == pytest.approx(1.0, abs=0.01)
    assert machine.angles_deg(line.now_s) == pytest.approx((1.0, 0.5), abs=0.0065)


class SlowBanner(Recorder):
    """In its first move it says that it has homed, a byte every 20 ms, and answers after that."""

    def __init__(self) -> None:
        super().__init__(PtuMachine(PtuModel()))
        self._left, self._late, self._next_s = HOMED, b"", 0.0

    def receive(self, data: bytes, now_s: float) -> bytes:
        self._late += super().receive(data, now_s)
        return self.advance(now_s)

    def advance(self, now_s: float) -> bytes:
        self._late += super().advance(now_s)
        if b"TP311 " not in self.received or not self._left:
            said, self._late = self._late, b""
            return said
        if now_s < self._next_s:
            return b""
        said, self._left, self._next_s = self._left[:1], self._left[1:], now_s + 0.02
        return said


def test_a_banner_that_comes_in_pieces_is_a_restart_all_the_same() -> None:
    head, line = head_on(SlowBanner())
    with pytest.raises(HeadError, match="restarted in the middle"):
        head.move_to(4.0, 2.0)
    assert line.sent[-1] == b"H "


def test_both_limit_switches_are_no_restart() -> None:
    class Striking(PtuMachine):
        def hit_limit(self, now_s: float) -> bytes:
            return super().hit_limit(now_s) + b"!T"

    head, _ = head_on(Striking(PtuModel(limit_hit_at_move=1)))
    with pytest.raises(HeadError, match="ran into its pan and tilt limit switch"):
        head.move_to(4.0, 2.0)


def test_a_restart_between_two_moves_shows_in_its_speed_and_it_is_greeted_again() -> None:
    machine = PtuMachine(PtuModel())
    head, line = head_on(machine, speed_deg_s=1.0)
    head.move_to(0.0, 0.0)
    machine.pan.speed_deg_s = 30.0
    line.sent.clear()
    with capture_logs() as logs:
        head.move_to(0.5, 0.0)
    assert [log["event"] for log in logs] == ["head_restarted"]
    assert b"CI " in line.sent
    assert machine.pan.speed_deg_s == pytest.approx(1.0, abs=0.01)


def test_a_head_that_lost_its_position_between_two_moves_does_not_move() -> None:
    """Restarted without homing it says 0 where it stands: all limits would be off by as much."""
    head, line = head_on(PtuMachine(PtuModel()))
    head.move_to(3.0, 0.0)
    line.machine = PtuMachine(PtuModel())
    line.sent.clear()
    with pytest.raises(HeadError, match=r"came to rest at pan 3\.\d+ .* now says pan 0\.000"):
        head.move_to(3.0, 1.0)
    assert not any(data.startswith(b"PP3") for data in line.sent)
    head.move_to(1.0, 1.0)  # said once; then it is the engineer's decision


def test_a_port_that_another_program_has_asks_nobody_to_cut_the_power() -> None:
    """Nothing was sent, so nothing turns."""
    ends = pty.openpty()
    name = os.ttyname(ends[1])
    try:
        fcntl.flock(ends[1], fcntl.LOCK_EX)  # as programs mark a serial port as theirs
        with pytest.raises(HeadLostError, match=name) as refused:
            PtuHead(SerialLine(name, 9600), SETTINGS).move_to(1.0, 1.0)
    finally:
        for end in ends:
            os.close(end)
    assert "Cut the power" not in str(refused.value)
    assert "could not be halted" not in str(refused.value)
