"""Every pan-tilt head keeps the same promises: ASCII and Pelco-D over a port, and in process.

The heads at the other end of the port are simulated ones that speak the protocol; a Pelco-D head
comes with and without answers where it is.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.errors import HeadError, HeadLimitError, HeadLostError
from drivers.heads.pelco_d import PelcoHead, TimedPelcoHead, message
from drivers.heads.ptu_ascii import PtuHead
from drivers.heads.serial_line import SerialLine
from drivers.sim.head import SimulatedHead
from drivers.sim.head_pelco import PelcoMachine, PelcoModel
from drivers.sim.head_ptu import PtuMachine, PtuModel
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.drivers.heads.lines import SETTINGS as QUICK_SETTINGS
from tests.drivers.heads.lines import Bench, PortBench
from tests.drivers.sim.rigs import site
from tests.waiting import PATIENCE_S, wait_for

SETTINGS = replace(QUICK_SETTINGS, answer_timeout_s=1.5)
"""At a port a busy machine may take long to answer."""
FASTER = 20.0
"""The heads at the ports live so many times faster."""
STOP = message(1, 0, 0, 0, 0)
TIMED_DEG_S = 2.0
"""True speed of the head that is moved by time, at the factor of its server."""


@pytest.fixture
def simulated() -> Bench:
    world = World(site(), SimSettings(scenarios=()))
    model = world.settings.head
    return Bench(SimulatedHead(world), SETTINGS, model.arcsec_per_count / 3600.0, world.head_deg)


@pytest.fixture
def ptu(tmp_path: Path) -> Iterator[Bench]:
    model = PtuModel()
    port = PortBench(lambda: PtuMachine(model), tmp_path / "head", FASTER)
    head = PtuHead(SerialLine(str(tmp_path / "head"), 9600), SETTINGS)
    yield port.bench(head, SETTINGS, model.arcsec_per_count / 3600.0, b"H ")
    head.close()
    port.unplug()


@pytest.fixture
def pelco(tmp_path: Path) -> Iterator[Bench]:
    port = PortBench(lambda: PelcoMachine(PelcoModel()), tmp_path / "head", FASTER)
    head = PelcoHead(SerialLine(str(tmp_path / "head"), 2400), SETTINGS)
    yield port.bench(head, SETTINGS, 0.01, STOP)
    head.close()
    port.unplug()


@pytest.fixture
def timed(tmp_path: Path) -> Iterator[Bench]:
    """Slow enough that a stop which a busy machine sends 0.3 s late is within its tolerance."""
    model = PelcoModel(feedback=False, accel_deg_s2=1e4, speed_deg_s=TIMED_DEG_S)
    port = PortBench(lambda: PelcoMachine(model), tmp_path / "head", speed_factor=1.0)
    settings = replace(SETTINGS, speed_deg_s=TIMED_DEG_S)
    line = SerialLine(str(tmp_path / "head"), 2400)
    head = TimedPelcoHead(line, settings, speed_level=0x3F)
    yield port.bench(head, settings, 0.6, STOP)
    head.close()
    port.unplug()


HEADS = ["simulated", "ptu", "pelco", "timed"]


@pytest.fixture(params=HEADS)
def bench(request: pytest.FixtureRequest) -> Bench:
    chosen: Bench = request.getfixturevalue(request.param)
    return chosen


@pytest.fixture(params=HEADS[1:])
def port_bench(request: pytest.FixtureRequest) -> Bench:
    chosen: Bench = request.getfixturevalue(request.param)
    return chosen


def near(one: tuple[float, float], other: tuple[float, float], within_deg: float) -> bool:
    return all(abs(a - b) <= within_deg for a, b in zip(one, other, strict=True))


def test_it_goes_where_asked_within_a_count_and_says_where_it_is(bench: Bench) -> None:
    for asked in ((1.0, -0.5), (-1.2345, 0.789), (0.0, 0.0)):
        bench.head.move_to(*asked)
        assert near(bench.angles_deg(), asked, bench.count_deg)
        said = bench.head.position_deg()
        assert (said is not None) == bench.head.reports_position
        if said is not None:
            assert near(said, bench.angles_deg(), bench.count_deg)


def test_when_a_move_returns_the_head_rests(bench: Bench) -> None:
    bench.head.move_to(2.0, 2.0)
    here = bench.angles_deg()
    bench.head.describe()
    assert bench.angles_deg() == here


@pytest.mark.parametrize("asked", [(5.01, 0.0), (0.0, -5.01), (float("nan"), 0.0)])
def test_beyond_a_limit_it_refuses_before_a_byte_is_sent(bench: Bench, asked) -> None:
    with pytest.raises(HeadLimitError, match=r"limit.* ask for less"):
        bench.head.move_to(*asked)
    assert bench.angles_deg() == (0.0, 0.0)
    if bench.has_received is not None:
        assert bench.has_received() == b""


def test_it_describes_itself_without_moving(bench: Bench) -> None:
    report = bench.head.describe()
    assert report.name
    assert report.position_deg == ((0.0, 0.0) if bench.head.reports_position else None)
    assert bench.angles_deg() == (0.0, 0.0)


def test_it_can_be_closed_twice_and_used_again(bench: Bench) -> None:
    bench.head.close()
    bench.head.move_to(0.5, 0.5)
    bench.head.close()
    bench.head.close()
    bench.head.move_to(0.0, 0.0)
    assert near(bench.angles_deg(), (0.0, 0.0), bench.count_deg)


def test_closing_halts(port_bench: Bench) -> None:
    port_bench.head.describe()
    port_bench.head.close()
    assert port_bench.has_received().endswith(port_bench.stop_bytes)


class Mover(threading.Thread):
    """Moves the head to its limits until it is kept from it."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(daemon=True)
        self._bench = bench
        self.error: HeadError | None = None

    def run(self) -> None:
        try:
            for sign in itertools.cycle((1.0, -1.0)):
                self._bench.head.move_to(sign * 4.9, 0.0)
        except HeadError as error:
            self.error = error


def moving(bench: Bench) -> Mover:
    """A thread that moves the head, on its way already."""
    mover = Mover(bench)
    mover.start()
    wait_for(lambda: abs(bench.angles_deg()[0]) > 0.3, "the head to move")
    return mover


def test_halt_from_another_thread_ends_the_move_and_the_motion(port_bench: Bench) -> None:
    mover = moving(port_bench)
    port_bench.head.halt()
    mover.join(PATIENCE_S)
    assert "halted" in str(mover.error)
    last = [(9.0, 9.0)]

    def rests() -> bool:
        last.append(port_bench.angles_deg())
        return last[-1] == last[-2]

    wait_for(rests, "the head to come to rest")
    assert port_bench.stop_bytes in port_bench.has_received()
    port_bench.head.move_to(0.0, 0.0)  # and it can be moved again
    if port_bench.head.reports_position:
        assert near(port_bench.angles_deg(), (0.0, 0.0), port_bench.count_deg)


def test_a_port_that_vanishes_in_a_move_and_comes_back_ends_it_halted(port_bench: Bench) -> None:
    mover = moving(port_bench)
    port_bench.unplug()
    port_bench.replug()
    mover.join(PATIENCE_S)
    assert isinstance(mover.error, HeadLostError)
    assert "vanished" in str(mover.error)
    assert "could not be halted" not in str(mover.error)
    assert port_bench.has_received().startswith(port_bench.stop_bytes)
    port_bench.head.move_to(0.5, -0.5)
    port_bench.head.describe()


def test_a_port_that_went_and_came_while_nobody_moved_is_no_error(port_bench: Bench) -> None:
    port_bench.head.move_to(0.0, 0.0)
    port_bench.head.describe()
    port_bench.unplug()
    port_bench.replug()
    port_bench.head.move_to(0.5, -0.5)
    assert near(port_bench.angles_deg(), (0.5, -0.5), port_bench.count_deg)


def test_a_port_that_does_not_come_back_is_reported_as_a_danger(tmp_path: Path) -> None:
    port = PortBench(lambda: PtuMachine(PtuModel()), tmp_path / "head", FASTER)
    head = PtuHead(SerialLine(str(tmp_path / "head"), 9600, reopen_s=0.2), SETTINGS)
    bench = port.bench(head, SETTINGS, 0.01, b"H ")
    mover = moving(bench)
    bench.unplug()
    mover.join(PATIENCE_S)
    assert isinstance(mover.error, HeadLostError)
    assert "could not be halted" in str(mover.error)
    assert "Cut the power" in str(mover.error)
    assert "\n" not in str(mover.error)
    head.close()


@pytest.mark.parametrize("kind", ["ptu", "pelco"])
@pytest.mark.parametrize("fault", ["silent_after", "nonsense_after"])
def test_a_head_that_falls_silent_or_talks_nonsense_in_a_move_is_halted(
    request: pytest.FixtureRequest, kind: str, fault: str
) -> None:
    bench: Bench = request.getfixturevalue(kind)
    mover = moving(bench)
    bench.set_faults(**{fault: 0})
    mover.join(PATIENCE_S)
    assert isinstance(mover.error, HeadError)
    assert ("no answer" if fault == "silent_after" else "nonsense") in str(mover.error)
    assert "\n" not in str(mover.error)
    assert bench.stop_bytes in bench.has_received()


@pytest.mark.parametrize("noise", [0.3])
def test_noise_on_the_line_costs_time_but_no_move(port_bench: Bench, noise: float) -> None:
    port_bench.set_faults(noise=noise)
    port_bench.head.move_to(1.0, -1.0)
    assert near(port_bench.angles_deg(), (1.0, -1.0), port_bench.count_deg)


def test_answers_that_come_late_are_not_taken_for_the_next(port_bench: Bench) -> None:
    """0.1 s at the wire, well within the deadline."""
    factor = 1.0 if not port_bench.head.reports_position else FASTER
    port_bench.set_faults(latency_s=0.1 * factor)
    port_bench.head.move_to(1.0, -1.0)
    assert near(port_bench.angles_deg(), (1.0, -1.0), port_bench.count_deg)
