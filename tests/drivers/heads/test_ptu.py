"""The ASCII pan-tilt unit: bytes on the wire as published, and what is made of bad answers.

Published: PTU-D300 User's Manual 2.19, E Series Command Reference Manual, reports of real units.
The line is straight to the simulated machine, in the machine's own time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.errors import HeadError, HeadLimitError, HeadLostError
from drivers.heads.ptu_ascii import PtuHead
from drivers.sim.head_machine import Faults, FaultyHead
from drivers.sim.head_ptu import PtuMachine, PtuModel
from tests.drivers.heads.lines import SETTINGS, MachineLine
from tests.exhaustive import one_of

D46 = PtuModel(arcsec_per_count=185.14, echo=False)
D300 = PtuModel(
    arcsec_per_count=185.14,
    pan_limits_deg=(-158.93, 158.93),
    tilt_limits_deg=(-46.67, 31.08),
    echo=False,
)
WIDE = replace(SETTINGS, pan_limits_deg=(-170.0, 170.0), tilt_limits_deg=(-90.0, 90.0))


class Terminal:
    """Somebody who types, and waits for the answer."""

    def __init__(self, model: PtuModel) -> None:
        self.machine = PtuMachine(model)
        self.now_s = 0.0

    def type(self, text: str, wait_s: float = 0.0) -> str:
        said = self.machine.receive(text.encode(), self.now_s)
        self.now_s += wait_s
        return (said + self.machine.advance(self.now_s)).decode()


# ------------------------------------------------------------ the simulated unit


def test_manual_s_first_example_verbose_and_terse() -> None:
    """PP-2500 *, A *, PP * Current Pan position is -2500, terse * -2500."""
    terminal = Terminal(D300)
    assert terminal.type("PP-2500 ") == "*\r\n"
    assert terminal.type("A ") == ""
    assert terminal.type("", wait_s=60.0) == "*\r\n"
    assert terminal.type("PP ") == "* Current Pan position is -2500\r\n"
    assert terminal.type("FT ") == "*\r\n"
    assert terminal.type("PP\r") == "* -2500\r\n"


def test_manual_s_limits() -> None:
    """PX and TN as in the manual; PP3200 beyond them is refused, and taken when they are off."""
    terminal = Terminal(D300)
    assert terminal.type("PN ") == "* Minimum Pan position is -3090\r\n"
    assert terminal.type("PX ") == "* Maximum Pan position is 3090\r\n"
    assert terminal.type("TN ") == "* Minimum Tilt position is -907\r\n"
    assert terminal.type("TX ") == "* Maximum Tilt position is 604\r\n"
    assert terminal.type("LE ") == "*\r\n"
    assert terminal.type("PP3200 ") == "! Maximum allowable Pan position is 3090\r\n"
    assert terminal.type("PP-3200 ") == "! Minimum allowable Pan position is -3090\r\n"
    assert terminal.type("LD PP3090 PP3200 ") == "*\r\n*\r\n*\r\n"


def test_manual_s_echo() -> None:
    """With echo on, the answer stands behind what was typed: PP * 22."""
    terminal = Terminal(replace(D300, echo=True))
    assert terminal.type("FT ") == "FT *\r\n"
    terminal.type("PP22 ", wait_s=20.0)
    assert terminal.type("PP ") == "PP * 22\r\n"
    assert terminal.type("ED ") == "ED *\r\n"
    assert terminal.type("PP ") == "* 22\r\n"
    assert terminal.type("EE ") == "*\r\n"
    assert terminal.type("PP ") == "PP * 22\r\n"


def test_reports_of_real_units() -> None:
    r"""`\n* 23.142857\r\n`, `\n! Illegal Command Entered\r\n`."""
    terminal = Terminal(PtuModel(leading_lf=True, echo=False))
    terminal.type("FT ")
    assert terminal.type("PR ") == "\n* 23.142857\r\n"
    assert terminal.type("XY ") == "\n! Illegal Command Entered\r\n"


def test_a_reset_ends_with_both_limits_found() -> None:
    terminal = Terminal(D46)
    terminal.type("PP97 ", wait_s=20.0)
    assert terminal.type("R ", wait_s=20.0) == "!T!T!P!P*\r\n"
    assert terminal.type("FT PP ").endswith("* 0\r\n")


def test_offsets_count_from_where_it_is() -> None:
    terminal = Terminal(D46)
    terminal.type("FT PP40 TP-20 ", wait_s=20.0)
    terminal.type("PO10 TO-5 ", wait_s=20.0)
    assert terminal.type("PP TP ") == "* 50\r\n* -25\r\n"


def test_speed_and_acceleration_are_kept_and_obeyed() -> None:
    terminal = Terminal(D46)
    assert terminal.type("FT PS100 PA200 TS50 TA60 PS PA TS TA ").split() == [
        *["*"] * 5,
        *["*", "100", "*", "200", "*", "50", "*", "60"],
    ]
    terminal.type("PP500 ")  # half a second up, 4.5 along, half a second down: 50 mark the ends
    assert terminal.type("", wait_s=3.0) == ""
    assert terminal.type("PP ") == "* 275\r\n"
    assert terminal.type("", wait_s=2.6) == ""
    assert terminal.type("PP ") == "* 500\r\n"


def test_halt_needs_no_turn_and_brakes() -> None:
    """H ends an await at once; the head brakes, and rests short of where it was sent."""
    terminal = Terminal(D46)
    terminal.type("FT PP2000 A ", wait_s=3.0)
    assert terminal.type("H ") == "*\r\n*\r\n"
    here = terminal.type("PP ", wait_s=5.0)
    there = terminal.type("PP ", wait_s=5.0)
    assert 100 < int(here[2:]) <= int(there[2:]) < 1900
    assert terminal.type("PP ") == there


def test_hamlib_s_rotctl_finds_what_it_expects() -> None:
    """What `rotctl -m 2501` of Hamlib 4.6.2 sent to this simulation, and what it then showed.

    5 deg of azimuth are 97 counts of 185.14", truncated; read back they are 4.9885 deg.
    """
    terminal = Terminal(replace(D46, echo=True))
    terminal.type("ED\n")
    assert terminal.type("FT\n") == "*\r\n"
    assert terminal.type("PR\n") == "* 185.140000\r\n"
    assert terminal.type("TR\n") == "* 185.140000\r\n"
    assert terminal.type("PP97 TP-97\n", wait_s=2.0).startswith("*\r\n")
    assert terminal.type("PP\n") == "* 97\r\n"
    assert terminal.type("TP\n") == "* -97\r\n"
    assert terminal.machine.angles_deg(99.0) == pytest.approx((4.9885, -4.9885), abs=1e-4)
    assert terminal.type("H\n") == "*\r\n"
    assert terminal.type("V\n").startswith("* Pan-Tilt Controller")


# ------------------------------------------------------------ the driver


def head_on(machine, **changes: object) -> tuple[PtuHead, MachineLine]:
    line = MachineLine(machine)
    return PtuHead(line, replace(WIDE, **changes)), line


def test_the_driver_says_hello_once_and_then_moves() -> None:
    """5 deg is 97 counts on a D46; where the head then is, it is asked for."""
    head, line = head_on(PtuMachine(D46), pan_limits_deg=(-6.0, 6.0), speed_deg_s=2.0)
    head.move_to(5.0, -2.5)
    modes = ["ED", "FT", "I", "CI"]
    hello = [*modes, "PR", "PN", "PX", "PS39", "TR", "TN", "TX", "TS39", "PS", "TS", "PP", "TP"]
    sent = [data.decode().strip() for data in line.sent]
    assert sent[: len(hello) + 2] == [*hello, "PP97", "TP-49"]
    assert set(sent[len(hello) + 2 :]) == {"PP", "TP"}
    assert head.position_deg() == pytest.approx((97 * 185.14 / 3600, -49 * 185.14 / 3600))
    line.sent.clear()
    head.move_to(0.0, 0.0)
    again = [data.decode().strip() for data in line.sent[:6]]
    assert again == ["PS", "TS", "PP", "TP", "PP0", "TP0"]


@pytest.mark.parametrize("verbose", [False, True])
@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("leading_lf", [False, True])
def test_the_driver_reads_every_way_of_answering(verbose, echo, leading_lf) -> None:
    class Stubborn(PtuMachine):
        """Takes ED and FT, and stays as it is."""

        def receive(self, data: bytes, now_s: float) -> bytes:
            said = super().receive(data, now_s)
            self._echo, self._verbose = echo, verbose
            return said

    head, _ = head_on(Stubborn(PtuModel(leading_lf=leading_lf)))
    head.move_to(-1.0, 1.0)
    assert head.position_deg() == pytest.approx((-1.0, 1.0), abs=0.0065)
    report = head.describe()
    assert "Pan-Tilt Controller" in report.name
    assert report.power
    assert "24.9" in report.power


def test_the_head_s_own_limits_count_too() -> None:
    head, line = head_on(PtuMachine(D46))
    with pytest.raises(
        HeadLimitError, match=r"tilt 40 deg is beyond .* 30.9595 deg; .*in the head itself"
    ):
        head.move_to(0.0, 40.0)
    assert not [data for data in line.sent if data.startswith((b"PP-", b"PP0", b"TP0", b"TP7"))]


def test_counts_never_round_across_a_limit() -> None:
    head, line = head_on(PtuMachine(D46), pan_limits_deg=(-4.99, 4.99))
    head.move_to(4.99, 0.0)  # 97.03 counts
    head.move_to(-4.99, 0.0)
    assert b"PP97 " in line.sent
    head, line = head_on(PtuMachine(D46), pan_limits_deg=(-4.98, 4.98))
    head.move_to(4.98, 0.0)  # 96.83 counts: 97 would be 4.988 deg
    assert b"PP96 " in line.sent


def test_a_refusal_is_reported_in_the_head_s_words_and_halts() -> None:
    class Choosy(PtuMachine):
        def set_value(self, axis, name, what, value, now_s):
            if what == "S":
                return self.refusal("Minimum allowable Pan speed is 57")
            return super().set_value(axis, name, what, value, now_s)

    head, line = head_on(Choosy(D46), speed_deg_s=1.0)
    with pytest.raises(HeadError, match=r"refuses PS19 .*speed is 57.* pan_tilt.speed_deg_s"):
        head.move_to(1.0, 0.0)
    assert line.sent[-1] == b"H "


def test_a_limit_switch_hit_on_the_way_ends_the_move_halted() -> None:
    head, line = head_on(PtuMachine(PtuModel(limit_hit_at_move=3)))
    head.move_to(1.0, 0.0)
    with pytest.raises(HeadError, match=r"pan limit switch.* lost count.*clear the way first"):
        head.move_to(-4.0, 0.0)
    assert line.sent[-1] == b"H "


def test_limit_messages_of_its_own_power_on_are_no_fault() -> None:
    """A head that was just switched on ends its reset while it is being greeted."""

    class Waking(PtuMachine):
        def receive(self, data: bytes, now_s: float) -> bytes:
            said = super().receive(data, now_s)
            return b"!T!T!P!P*\r\n!P" + said if self.commands == 1 else said

    head, _ = head_on(Waking(PtuModel()))
    head.move_to(1.0, 1.0)
    assert head.position_deg() == pytest.approx((1.0, 1.0), abs=0.0065)


def test_a_jammed_head_is_noticed_in_time_and_halted() -> None:
    head, line = head_on(PtuMachine(PtuModel(jam_at_move=1)))
    with pytest.raises(HeadError, match=r"stuck at pan [01]\.\d+ .*cables"):
        head.move_to(4.0, 0.0)
    assert line.sent[-1] == b"H "
    assert line.now_s < 5.0


def test_a_head_too_slow_for_its_deadline_is_halted_by_it() -> None:
    head, line = head_on(PtuMachine(PtuModel()), speed_deg_s=0.1, move_timeout_s=10.0)
    with pytest.raises(HeadError, match=r"within 10 s.* pan_tilt.move_timeout_s"):
        head.move_to(4.0, 0.0)
    assert line.sent[-1] == b"H "
    assert line.now_s < 11.0


@pytest.mark.parametrize("commands", range(14))
def test_silence_at_any_point_ends_within_the_deadlines(commands: int) -> None:
    """Three attempts at the question, three at the halt, and quiet before each repetition."""
    machine = FaultyHead(PtuMachine(PtuModel()), Faults(silent_after=commands))
    head, line = head_on(machine)
    with pytest.raises(HeadError, match=r"no answer to .*It could not be halted.*Cut the power"):
        head.move_to(1.0, 0.0)
    assert line.sent[-1] == b"H "
    assert line.now_s < 6 * (SETTINGS.answer_timeout_s + 0.2) + 1.0


@pytest.mark.parametrize("seed", range(5))
def test_nonsense_ends_with_an_error_and_a_halt(seed: int) -> None:
    machine = FaultyHead(PtuMachine(PtuModel()), Faults(nonsense_after=14, seed=seed))
    head, line = head_on(machine)
    with pytest.raises(HeadError, match=r"nonsense|no answer|refuses"):
        head.move_to(3.0, 0.0)
    assert line.sent[-1] == b"H "


def test_a_resolution_that_cannot_be_is_nonsense_too() -> None:
    head, line = head_on(PtuMachine(PtuModel(arcsec_per_count=1e6)))
    with pytest.raises(HeadError, match="cannot be"):
        head.move_to(1.0, 0.0)
    assert line.sent[-1] == b"H "


@pytest.mark.parametrize("seed", range(0, 20, one_of(2)))
def test_noise_before_half_of_all_answers_is_lived_with(seed: int) -> None:
    machine = FaultyHead(PtuMachine(PtuModel()), Faults(noise=0.3, seed=seed))
    head, _ = head_on(machine)
    head.move_to(2.0, -1.0)
    assert machine.angles_deg(1e6) == pytest.approx((2.0, -1.0), abs=0.0065)


def test_a_command_that_noise_has_hit_is_said_again() -> None:
    class Deaf(PtuMachine):
        """Hears rubbish at the start of every third command."""

        def receive(self, data: bytes, now_s: float) -> bytes:
            return super().receive(b"\x8fz" + data if self.commands % 3 == 0 else data, now_s)

    head, _ = head_on(Deaf(PtuModel()))
    head.move_to(2.0, -1.0)
    assert head.position_deg() == pytest.approx((2.0, -1.0), abs=0.0065)


def interrupt(error: BaseException, line: MachineLine) -> Callable[[], None]:
    """Raise once, as soon as the head moves."""

    def on_read() -> None:
        if abs(line.machine.angles_deg(line.now_s)[0]) > 0.5:
            line.on_read = lambda: None
            raise error

    return on_read


def test_ctrl_c_halts_and_stays_ctrl_c() -> None:
    machine = PtuMachine(PtuModel())
    head, line = head_on(machine)
    line.on_read = interrupt(KeyboardInterrupt(), line)
    with pytest.raises(KeyboardInterrupt):
        head.move_to(4.0, 0.0)
    assert line.sent[-1] == b"H "
    assert 0.5 < machine.angles_deg(1e6)[0] < 3.0


def test_ctrl_c_with_the_line_gone_says_that_it_could_not_be_halted() -> None:
    head, line = head_on(PtuMachine(PtuModel()))

    def on_read() -> None:
        if abs(line.machine.angles_deg(line.now_s)[0]) > 0.5:
            line.plugged = False
            raise KeyboardInterrupt

    line.on_read = on_read
    with pytest.raises(
        HeadError, match=r"KeyboardInterrupt\. It could not be halted.*Cut the power"
    ):
        head.move_to(4.0, 0.0)


def test_a_line_that_was_lost_is_greeted_again() -> None:
    head, line = head_on(PtuMachine(PtuModel()))
    head.move_to(0.0, 0.0)
    line.plugged = False
    with pytest.raises(HeadLostError):
        head.position_deg()
    line.plugged, line.machine = True, PtuMachine(PtuModel(arcsec_per_count=185.14))
    line.sent.clear()
    head.move_to(0.0, 1.0)
    assert line.sent[0] == b"ED "
    assert head.position_deg() == pytest.approx((0.0, 19 * 185.14 / 3600))
