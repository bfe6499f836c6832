"""Pelco-D: bytes on the wire as published (TF-0002), answers found in noise, moves by time."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import HeadError, HeadLostError
from drivers.heads.pelco_d import (
    ASK_PAN,
    ASK_TILT,
    DOWN,
    LEFT,
    PAN_IS,
    SET_PAN,
    SET_TILT,
    TILT_IS,
    PelcoHead,
    TimedPelcoHead,
    angle_in,
    angle_message,
    message,
)
from drivers.sim.head_machine import Faults, FaultyHead
from drivers.sim.head_pelco import PelcoMachine, PelcoModel
from tests.drivers.heads.lines import SETTINGS, MachineLine
from tests.exhaustive import one_of

STOP = message(1, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("sent", "published"),
    [
        (message(1, 0, LEFT, 0x20, 0), "FF 01 00 04 20 00 25"),
        (message(2, 0, 0, 0, 0), "FF 02 00 00 00 00 02"),
        (message(10, 0x88, 0x80 | DOWN, 0, 0x40), "FF 0A 88 90 00 40 62"),
        (message(0xFF, 0, 0x07, 0, 0xFF), "FF FF 00 07 00 FF 05"),
        (angle_message(1, SET_PAN, 90.0), "FF 01 00 4B 23 28 97"),
        # sums by hand: bytes 2 to 6 modulo 256
        (message(1, 0, 0x03, 0, 1), "FF 01 00 03 00 01 05"),
        (message(1, 0, ASK_PAN, 0, 0), "FF 01 00 51 00 00 52"),
        (message(1, 0, ASK_TILT, 0, 0), "FF 01 00 53 00 00 54"),
        (angle_message(1, SET_TILT, -1.0), "FF 01 00 4D 8C 3C 16"),
        (angle_message(1, SET_PAN, 359.999), "FF 01 00 4B 00 00 4C"),
        (angle_message(1, SET_PAN, -0.001), "FF 01 00 4B 00 00 4C"),
    ],
)
def test_messages_are_the_published_bytes(sent: bytes, published: str) -> None:
    assert sent == bytes.fromhex(published)


@pytest.mark.parametrize(
    ("heard", "angle_deg"),
    [
        ("FF 01 00 59 23 28 A5", 90.0),
        ("FF 01 00 59 8C 3C 22", -1.0),
        ("FF 01 00 59 46 50 F0", 180.0),
        ("FF 01 00 59 46 51 F1", -179.99),
        ("01 59 23 28 A5", 90.0),  # five bytes, without FF and command1
        ("FF 01 00 52  FF 01 00 59 23 28 A5", 90.0),  # a general answer first, four bytes
        ("FF FF 13 FF 01 00 59 23 28 A5", 90.0),  # noise, an FF in it
        ("FF 01 00 51 00 00 52 FF 01 00 59 23 28 A5", 90.0),  # its own question, as on two wires
        ("FF 01 00 59 23 28 A6", None),  # a wrong sum
        ("FF 02 00 59 23 28 A6", None),  # another head
        ("FF 01 00 5B 23 28 A7", None),  # tilt, not pan
        ("FF 01 00 59 8C A0 86", None),  # 360.00 deg
        ("FF 01 00 59 23 28", None),  # not whole yet
        ("", None),
    ],
)
def test_answers_are_found_by_ff_and_sum(heard: str, angle_deg: float | None) -> None:
    assert angle_in(bytes.fromhex(heard), 1, PAN_IS) == angle_deg


@given(
    angle=st.integers(-17999, 18000),
    address=st.integers(1, 254),
    before=st.binary(max_size=12).filter(lambda data: 0x5B not in data),
    after=st.binary(max_size=6),
)
def test_every_angle_comes_back_through_noise(angle, address, before, after) -> None:
    answer = angle_message(address, TILT_IS, angle / 100.0)
    assert angle_in(before + answer + after, address, TILT_IS) == angle / 100.0


def head_on(model: PelcoModel, faults: Faults | None = None, **changes):
    machine = FaultyHead(PelcoMachine(model), faults or Faults())
    line = MachineLine(machine)
    return PelcoHead(line, replace(SETTINGS, **changes), model.address), line


def test_the_driver_sets_both_axes_and_asks_until_there() -> None:
    head, line = head_on(PelcoModel(), pan_limits_deg=(-100.0, 100.0))
    head.move_to(90.0, -1.0)
    first, second = (
        line.sent.index(angle_message(1, *order)) for order in ((SET_PAN, 90.0), (SET_TILT, -1.0))
    )
    assert first < second
    asked = set(line.sent) - {angle_message(1, SET_PAN, 90.0), angle_message(1, SET_TILT, -1.0)}
    assert asked == {message(1, 0, ASK_PAN, 0, 0), message(1, 0, ASK_TILT, 0, 0)}
    assert line.machine.angles_deg(line.now_s) == (90.0, -1.0)


@pytest.mark.parametrize(
    "model",
    [
        PelcoModel(short_answers=True),
        PelcoModel(general_answers=True),
        PelcoModel(short_answers=True, general_answers=True),
        PelcoModel(address=254),
    ],
)
def test_every_way_of_answering_is_read(model: PelcoModel) -> None:
    head, line = head_on(model)
    head.move_to(-3.21, 1.23)
    assert head.position_deg() == (-3.21, 1.23)
    assert line.machine.angles_deg(line.now_s) == (-3.21, 1.23)


def test_a_head_with_another_address_is_not_moved() -> None:
    machine = PelcoMachine(PelcoModel(address=2))
    head = PelcoHead(MachineLine(machine), SETTINGS, address=1)
    with pytest.raises(HeadError, match=r"no answer where its pan is .*address"):
        head.move_to(1.0, 0.0)
    assert machine.commands == 0


def test_a_head_that_never_answers_is_recognised_before_it_moves() -> None:
    head, line = head_on(PelcoModel(feedback=False))
    with pytest.raises(HeadError, match="reports_position = false"):
        head.move_to(1.0, 0.0)
    assert angle_message(1, SET_PAN, 1.0) not in line.sent
    assert line.sent[-3:] == [STOP] * 3
    assert line.now_s < 3 * SETTINGS.answer_timeout_s + 1.0


@pytest.mark.parametrize("faults", [Faults(silent_after=5), Faults(nonsense_after=5)])
def test_silence_and_nonsense_on_the_way_end_halted(faults: Faults) -> None:
    head, line = head_on(PelcoModel(), faults)
    with pytest.raises(HeadError, match=r"no answer|nonsense"):
        head.move_to(4.0, 0.0)
    assert line.sent[-3:] == [STOP] * 3
    assert line.now_s < 3 * SETTINGS.answer_timeout_s + 2.0


def test_a_jammed_head_is_halted() -> None:
    head, line = head_on(PelcoModel(jam_at_move=1))
    with pytest.raises(HeadError, match="stuck at pan"):
        head.move_to(4.0, 0.0)
    assert line.sent[-1] == STOP


def test_a_head_that_lost_its_position_between_two_moves_does_not_move() -> None:
    head, line = head_on(PelcoModel())
    head.move_to(3.0, 0.0)
    line.machine = PelcoMachine(PelcoModel())
    line.sent.clear()
    with pytest.raises(HeadError, match=r"came to rest at pan 3\.000 .* now says pan 0\.000"):
        head.move_to(3.0, 1.0)
    assert angle_message(1, SET_PAN, 3.0) not in line.sent
    head.move_to(1.0, 1.0)


@pytest.mark.parametrize("seed", range(0, 20, one_of(2)))
def test_noise_is_lived_with(seed: int) -> None:
    head, line = head_on(PelcoModel(), Faults(noise=0.5, seed=seed))
    head.move_to(2.0, -1.0)
    assert line.machine.angles_deg(line.now_s) == (2.0, -1.0)


def test_a_head_that_rests_a_little_beside_is_near_enough() -> None:
    class Coarse(PelcoMachine):
        """Comes to rest 0.04 deg short, whatever it is asked."""

        def angle_answer(self, command: int, angle_deg: float) -> bytes:
            return super().angle_answer(command, angle_deg - 0.04)

    line = MachineLine(Coarse(PelcoModel()))
    head = PelcoHead(line, SETTINGS)
    head.move_to(1.0, 1.0)
    assert head.position_deg() == (0.96, 0.96)
    exact = PelcoHead(MachineLine(Coarse(PelcoModel())), replace(SETTINGS, tolerance_deg=0.01))
    with pytest.raises(HeadError, match="stuck"):
        exact.move_to(1.0, 1.0)


# ------------------------------------------------------------ without answers


SPEED_DEG_S = 0.5


def timed_on(model: PelcoModel, **changes):
    line = MachineLine(PelcoMachine(model))
    settings = replace(SETTINGS, speed_deg_s=SPEED_DEG_S, **changes)
    return TimedPelcoHead(line, settings, model.address, speed_level=1), line


SLOW = PelcoModel(feedback=False, speed_deg_s=63 * SPEED_DEG_S, accel_deg_s2=1e4)
"""Half a degree a second at level 1."""


def test_a_head_without_answers_is_turned_for_as_long_as_it_takes() -> None:
    head, line = timed_on(SLOW)
    head.move_to(1.0, -0.25)
    assert line.sent == [
        message(1, 0, 0x02, 1, 0),  # right
        *[STOP] * 3,
        message(1, 0, 0x10, 0, 1),  # down
        *[STOP] * 3,
    ]
    assert line.machine.angles_deg(line.now_s) == pytest.approx((1.0, -0.25), abs=0.01)
    head.move_to(-0.5, 0.0)
    assert line.machine.angles_deg(line.now_s) == pytest.approx((-0.5, 0.0), abs=0.01)
    assert head.position_deg() is None
    assert not head.reports_position


def test_it_takes_the_limits_from_where_it_reckons_to_be() -> None:
    head, line = timed_on(SLOW, move_timeout_s=1.0)
    with pytest.raises(HeadError, match=r"4 s on the way .* pan_tilt.move_timeout_s"):
        head.move_to(2.0, 0.0)
    assert line.sent == []


def test_a_turn_that_was_broken_off_is_reckoned_with() -> None:
    head, line = timed_on(SLOW)

    def on_read() -> None:
        if line.machine.angles_deg(line.now_s)[0] > 0.7:
            line.on_read = lambda: None
            raise KeyboardInterrupt

    line.on_read = on_read
    with pytest.raises(KeyboardInterrupt):
        head.move_to(2.0, 0.0)
    assert line.sent[-1] == STOP
    head.move_to(0.0, 0.0)
    assert line.machine.angles_deg(line.now_s) == pytest.approx((0.0, 0.0), abs=0.02)


def test_a_line_that_is_lost_while_it_turns_is_reported_as_a_danger() -> None:
    head, line = timed_on(SLOW)

    def on_read() -> None:
        line.plugged = line.now_s < 1.0

    line.on_read = on_read
    with pytest.raises(HeadLostError, match=r"vanished\. It could not be halted.*Cut the power"):
        head.move_to(2.0, 0.0)


def test_it_needs_a_speed() -> None:
    with pytest.raises(HeadError, match=r"set pan_tilt\.speed_deg_s"):
        TimedPelcoHead(MachineLine(PelcoMachine(SLOW)), SETTINGS)


# ------------------------------------------------------------ the simulated head


def test_the_simulated_head_turns_as_the_bits_say() -> None:
    """Left at 0x20 as published; then up and right at once, each at its own speed; then stop."""
    machine = PelcoMachine(PelcoModel(speed_deg_s=6.3, accel_deg_s2=1e6))
    assert machine.receive(bytes.fromhex("FF 01 00 04 20 00 25"), 0.0) == b""
    assert machine.angles_deg(1.0) == pytest.approx((-3.2, 0.0), abs=1e-3)
    machine.receive(message(1, 0, 0x0A, 0x3F, 0x0A), 1.0)
    assert machine.angles_deg(2.0) == pytest.approx((3.1, 1.0), abs=1e-3)
    machine.receive(STOP, 2.0)
    assert machine.angles_deg(9.0) == pytest.approx((3.1, 1.0), abs=1e-3)


def test_the_simulated_head_hears_only_whole_messages_with_the_right_sum() -> None:
    machine = PelcoMachine(PelcoModel())
    noise = bytes.fromhex("00 FF 13 FF 01 00 04 20 00 26 FF FF")
    machine.receive(noise, 0.0)
    assert machine.commands == 0
    question = message(1, 0, ASK_PAN, 0, 0)
    said = b"".join(machine.receive(question[i : i + 1], 0.0) for i in range(7))
    assert said == bytes.fromhex("FF 01 00 59 00 00 5A")
