"""Heads behind the network: over TCP as heads with Ethernet speak, and over a serial server."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from drivers.errors import HeadError, HeadLostError
from drivers.heads.pelco_d import PelcoHead
from drivers.heads.ptu_ascii import PtuHead
from drivers.heads.serial_line import SerialLine
from drivers.protocols import PanTiltHead
from drivers.sim.head_pelco import PelcoMachine, PelcoModel
from drivers.sim.head_ptu import PtuMachine, PtuModel
from tests.drivers.heads.lines import SETTINGS as QUICK_SETTINGS
from tests.drivers.heads.lines import PortBench
from tests.drivers.heads.network import Bridge
from tests.drivers.heads.test_head_contract import FASTER, Mover
from tests.waiting import PATIENCE_S, wait_for

SETTINGS = replace(QUICK_SETTINGS, answer_timeout_s=1.5)


@dataclass
class Remote:
    """A head, the bridge to it, and the simulated one at its other end."""

    head: PanTiltHead
    bridge: Bridge
    port: PortBench


@pytest.fixture(params=["socket", "rfc2217"])
def remote(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Remote]:
    port = PortBench(lambda: PtuMachine(PtuModel()), tmp_path / "head", FASTER)
    with Bridge(tmp_path / "head", rfc2217=request.param == "rfc2217") as bridge:
        head = PtuHead(SerialLine(bridge.url, 19200, reopen_s=PATIENCE_S), SETTINGS)
        yield Remote(head, bridge, port)
        head.close()
    port.unplug()


def moving(remote: Remote) -> Mover:
    """A thread that moves the head, on its way already."""
    bench = remote.port.bench(remote.head, SETTINGS, 0.01, b"H ")
    mover = Mover(bench)
    mover.start()
    wait_for(lambda: abs(bench.angles_deg()[0]) > 0.3, "the head to move")
    return mover


def test_it_moves_as_at_a_local_port(remote: Remote) -> None:
    for asked in ((1.0, -0.5), (-1.2, 0.8)):
        remote.head.move_to(*asked)
        assert remote.port.angles_deg() == pytest.approx(asked, abs=0.0065)
    assert "Pan-Tilt Controller" in remote.head.describe().name
    remote.head.close()
    remote.head.move_to(0.0, 0.0)


def test_a_serial_server_is_set_to_the_configured_baud_rate(remote: Remote) -> None:
    remote.head.position_deg()
    assert remote.bridge.baud == (19200 if remote.bridge.url.startswith("rfc2217") else 9600)


def test_bytes_of_all_values_pass_unchanged(tmp_path: Path) -> None:
    """Pelco-D begins each message with FF, which telnet doubles on its way."""
    port = PortBench(lambda: PelcoMachine(PelcoModel()), tmp_path / "head", FASTER)
    with Bridge(tmp_path / "head", rfc2217=True) as bridge:
        head = PelcoHead(SerialLine(bridge.url, 2400), SETTINGS)
        head.move_to(1.0, -2.55)
        assert port.angles_deg() == pytest.approx((1.0, -2.55), abs=0.01)
        head.close()
    port.unplug()


def test_a_connection_dropped_in_a_move_ends_it_halted_and_comes_back(remote: Remote) -> None:
    mover = moving(remote)
    received = len(remote.port.recorder.received)
    remote.bridge.drop()
    mover.join(PATIENCE_S)
    assert isinstance(mover.error, HeadLostError)
    assert "the connection was lost" in str(mover.error)
    assert "could not be halted" not in str(mover.error)
    assert "\n" not in str(mover.error)
    assert b"H " in remote.port.recorder.received[received:]
    remote.head.move_to(0.5, -0.5)


def test_a_connection_dropped_while_nobody_moves_is_no_error(remote: Remote) -> None:
    remote.head.move_to(0.5, 0.0)
    remote.bridge.drop()
    remote.head.move_to(1.0, -0.5)
    assert remote.port.angles_deg() == pytest.approx((1.0, -0.5), abs=0.0065)


def test_a_connection_that_does_not_come_back_is_reported_as_a_danger(tmp_path: Path) -> None:
    port = PortBench(lambda: PtuMachine(PtuModel()), tmp_path / "head", FASTER)
    with Bridge(tmp_path / "head") as bridge:
        line = SerialLine(bridge.url, 9600, reopen_s=0.2)
        remote = Remote(PtuHead(line, SETTINGS), bridge, port)
        mover = moving(remote)
    mover.join(PATIENCE_S)
    assert isinstance(mover.error, HeadLostError)
    said = str(mover.error)
    assert "could not be halted" in said
    assert "refuses the connection" in said
    assert "Cut the power" in said
    assert "\n" not in said
    remote.head.close()
    port.unplug()


@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
def test_a_port_where_nobody_listens_refuses_and_the_cure_is_named(scheme: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
    url = f"{scheme}://127.0.0.1:{number}"
    with pytest.raises(HeadLostError, match=rf"^{url}: .*refuses .*check the port number"):
        PtuHead(SerialLine(url, 9600), SETTINGS).describe()


def test_a_server_that_does_not_speak_rfc_2217_is_named(tmp_path: Path) -> None:
    port = PortBench(lambda: PtuMachine(PtuModel()), tmp_path / "head", FASTER)
    with Bridge(tmp_path / "head") as bridge:
        url = f"rfc2217://127.0.0.1:{bridge.number}"
        with pytest.raises(HeadLostError, match=r"does not speak RFC 2217; .* use socket://"):
            PtuHead(SerialLine(url, 9600), SETTINGS).describe()
    port.unplug()


def test_a_server_without_a_head_behind_it_is_a_head_that_does_not_answer() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        head = PtuHead(SerialLine(url, 9600), QUICK_SETTINGS)
        with pytest.raises(HeadError, match=r"no answer to ED .*check its power and cable"):
            head.describe()
        head.close()
