"""dcamd sends systemd its state over the socket it names, by path or in the abstract namespace."""

import os
import socket
from pathlib import Path

import pytest

from daemon.control.notify import Notifier
from tests.waiting import PATIENCE_S


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path: Path):
    """A datagram socket and the address that systemd would put in NOTIFY_SOCKET."""
    name = f"dcam-test-{os.getpid()}"
    address, given = (
        (f"\0{name}", f"@{name}")
        if request.param == "abstract"
        else (str(tmp_path / "notify"), str(tmp_path / "notify"))
    )
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(address)
        listening.settimeout(PATIENCE_S)
        yield listening, given


def test_states_arrive_as_systemd_reads_them(manager) -> None:
    listening, address = manager
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": address})
    notifier.ready()
    notifier.status("slot 2026-03-01T00:00:00Z\ngood")
    notifier.stopping()
    assert [listening.recv(1000) for _ in range(3)] == [
        b"READY=1",
        b"STATUS=slot 2026-03-01T00:00:00Z good",
        b"STOPPING=1",
    ]


@pytest.mark.parametrize("environ", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "/not/there"}])
def test_nobody_listening_is_no_error(environ) -> None:
    Notifier.from_environment(environ).ready()
