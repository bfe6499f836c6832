"""The control socket: a pause is a gap with its cause, and no client can disturb the slots."""

import contextlib
import json
import os
import resource
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.control import control_socket as control
from daemon.control.camera_lease import CameraLease
from daemon.control.control_socket import (
    MAX_CONNECTIONS,
    SOCKET_NAME,
    control_socket,
    paused_daemon,
)
from daemon.control.notify import Notifier
from daemon.errors import HardwareError
from daemon.slots.reporting import Reporter
from daemon.slots.runner import SlotRunner
from tests.waiting import PATIENCE_S


class Served:
    """A station whose runner is paused through the socket of its state directory."""

    def __init__(self, station) -> None:
        self.station = station
        self.closed = 0
        self.pause_ended = threading.Event()
        self.lease = CameraLease(self._close, self._changed)
        station.start()
        self.runner = SlotRunner(
            station.context,
            station.schedule,
            station.source,
            station.stop,
            None,
            Reporter(Notifier(None)),
            self.lease,
        )

    def _close(self) -> None:
        self.closed += 1

    def _changed(self, reason: str | None) -> None:
        if reason is None:
            self.pause_ended.set()

    def until_measuring(self) -> None:
        """Wait until the pause has ended."""
        assert self.pause_ended.wait(PATIENCE_S), "the pause did not end with its connection"


@pytest.fixture
def served(station) -> Iterator[Served]:
    served = Served(station)
    with control_socket(station.state, served.lease):
        yield served


@contextlib.contextmanager
def connected(state: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(PATIENCE_S)
        connection.connect(str(state / SOCKET_NAME))
        yield connection


@contextlib.contextmanager
def handles_for(connections: int) -> Iterator[None]:
    """Let this process, which is both ends of them, have so many connections open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 2 * connections + 200)), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def ask(connection: socket.socket, line: bytes) -> dict:
    connection.sendall(line + b"\n")
    return json.loads(connection.makefile("rb").readline())


def test_a_pause_is_a_gap_with_its_cause_and_ends_by_itself(served: Served) -> None:
    station = served.station
    served.runner.run(2)
    with paused_daemon(station.state, "calibration by dcam-ctl (pid 7)") as paused:
        assert paused
        assert served.closed == 1
        served.runner.run(3)
    served.until_measuring()
    served.runner.run(2)
    assert len(station.source.captures) == 4
    assert station.minutes() == [0, 1, 5, 6]
    assert station.gaps() == [(2, 4, "calibration")]
    assert station.store.gaps()[0].detail == "calibration by dcam-ctl (pid 7)"


def test_a_client_that_dies_lets_the_daemon_go_on(served: Served) -> None:
    with connected(served.station.state) as connection:
        assert ask(connection, b'{"command": "pause"}')["ok"]
        assert served.lease.reason == "paused"
        # no resume: the connection just goes away, as the kernel does it for a killed process
    served.until_measuring()
    served.runner.run(1)
    assert served.station.minutes() == [0]


def test_the_pause_waits_for_the_slot_in_progress(served: Served) -> None:
    """Between trigger and row nobody takes the cameras away."""
    reported = []
    asking = threading.Event()

    def pause_now() -> None:
        asking.set()
        with paused_daemon(served.station.state, "calibration"):
            reported.append(served.station.minutes())

    client = threading.Thread(target=pause_now)

    def during_the_capture() -> None:
        client.start()
        assert asking.wait(PATIENCE_S)
        assert not served.closed

    served.station.source.orders = {0: during_the_capture}
    served.runner.run(1)
    client.join(PATIENCE_S)
    assert reported == [[0]]


def test_a_second_pause_is_refused_and_says_who_has_it(served: Served) -> None:
    state = served.station.state
    with (
        paused_daemon(state, "calibration by pid 7"),
        pytest.raises(HardwareError, match="calibration by pid 7"),
        paused_daemon(state, "another"),
    ):
        pass


@pytest.mark.parametrize(
    "line",
    [
        b"\x00\xff\xfe garbage",
        b"{}",
        b'{"command": "reboot"}',
        b'{"command": "pause", "reason": 5}',
        b'{"command": "pause", "extra": 1}',
        b'{"command": "pause", "reason": "' + b"x" * 500 + b'"}',
        b"[" * 1500,
    ],
)
def test_nonsense_is_answered_and_changes_nothing(served: Served, line: bytes) -> None:
    with connected(served.station.state) as connection:
        answer = ask(connection, line)
        assert not answer["ok"]
        assert answer["error"].startswith("not understood")
        assert ask(connection, b'{"command": "status"}') == {
            **answer,
            "ok": True,
            "error": "",
            "paused": "",
        }
    assert served.closed == 0


def test_a_line_without_end_closes_that_connection_only(served: Served) -> None:
    state = served.station.state
    with connected(state) as endless, connected(state) as other:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            endless.sendall(b"x" * 100_000)
            assert endless.recv(1) == b""
        assert ask(other, b'{"command": "status"}')["ok"]


def test_a_crowd_of_silent_connections_does_not_stop_the_slots(served: Served) -> None:
    state = served.station.state
    with contextlib.ExitStack() as crowd, handles_for(1000):
        silent = []
        for _ in range(1000):
            with contextlib.suppress(OSError):  # refused is as good
                silent.append(crowd.enter_context(connected(state)))
        assert len(silent) >= MAX_CONNECTIONS
        served.runner.run(3)
    assert served.station.minutes() == [0, 1, 2]
    with paused_daemon(state, "calibration") as paused:
        assert paused


def test_who_asks_and_never_reads_is_let_go_and_delays_nobody(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "REQUEST_TIMEOUT_S", 0.5)
    state = served.station.state
    with connected(state) as slow:
        slow.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:  # until neither the answers nor the requests find room any more
                slow.send(b'{"command": "status"}\n' * 100)
        with connected(state) as other:
            assert ask(other, b'{"command": "status"}')["ok"]
        served.runner.run(2)
        slow.settimeout(PATIENCE_S)
        with contextlib.suppress(ConnectionError):
            while True:
                slow.sendall(b'{"command": "status"}\n')
    assert served.station.minutes() == [0, 1]
    with paused_daemon(state, "calibration") as paused:
        assert paused


def test_without_a_daemon_there_is_nobody_to_ask(tmp_path: Path) -> None:
    with paused_daemon(tmp_path, "calibration") as paused:
        assert not paused


def test_a_socket_left_by_a_killed_daemon_is_replaced(station) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(station.state / SOCKET_NAME))
    with paused_daemon(station.state, "calibration") as paused:
        assert not paused
    with (
        control_socket(station.state, CameraLease(lambda: None)),
        paused_daemon(station.state, "calibration") as paused,
    ):
        assert paused
    assert not (station.state / SOCKET_NAME).exists()


def test_a_state_directory_of_any_length_will_do(tmp_path: Path) -> None:
    """The kernel takes 107 bytes of a socket's path; the directory here is far longer."""
    state = tmp_path / ("long" * 30)
    state.mkdir()
    with (
        control_socket(state, CameraLease(lambda: None)),
        paused_daemon(state, "calibration") as paused,
    ):
        assert paused
        assert (state / SOCKET_NAME).stat().st_mode & 0o777 == 0o660


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to become somebody else")
def test_whoever_is_not_of_the_group_learns_so(station) -> None:
    with control_socket(station.state, CameraLease(lambda: None)):
        child = os.fork()
        if child == 0:
            for directory in (station.state, *station.state.parents):
                if directory != Path("/"):
                    directory.chmod(directory.stat().st_mode | 0o055)
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            code = 1
            with contextlib.suppress(BaseException):
                try:
                    with paused_daemon(station.state, "calibration"):
                        pass
                except HardwareError as error:
                    code = 0 if "not allowed; join the group" in str(error) else 2
            os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


WITHOUT_DESCRIPTORS = """
import os, resource, sys
from pathlib import Path
from daemon.control.camera_lease import CameraLease
from daemon.control.control_socket import control_socket

free = os.open("/", os.O_RDONLY)
os.close(free)
resource.setrlimit(resource.RLIMIT_NOFILE, (free + 2, free + 2))
with control_socket(Path(sys.argv[1]), CameraLease(lambda: None)):
    pass
"""
"""There is room for the socket and its directory, and none for an event loop."""


def test_without_descriptors_for_the_socket_the_process_still_ends(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_DESCRIPTORS, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "no_control_socket" in done.stdout + done.stderr
