"""The process of one camera behind a GenTL producer: takes calls from a socket, one at a time.

    python -m drivers.genicam.gentl_worker FD

A call comes as (name, arguments, deadline in s) and is answered with a `Reply`. The process ends
when the socket closes, or when a call exceeds its deadline: then the kernel's alarm ends it, as no
Python code would run while a producer hangs.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import MutableMapping
from multiprocessing.connection import Connection
from typing import Any

import structlog

from drivers.errors import DeviceLostError, DriverError
from drivers.genicam.gentl_calls import Call, Reply, Setup
from drivers.genicam.gentl_device import GentlDevice
from drivers.genicam.session import Session

_log = structlog.get_logger("dcam.drivers")

ALARM_MARGIN_S = 2.0
"""Who called has ended this process before; the alarm is for when that one is dead too."""


class _Collector:
    """Keeps what is logged, to be sent to the process that has a log."""

    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = []

    def __call__(
        self, _logger: object, level: str, entry: MutableMapping[str, Any]
    ) -> MutableMapping[str, Any]:
        self.entries.append({**entry, "level": level})
        raise structlog.DropEvent

    def take(self) -> list[dict[str, Any]]:
        """Give the entries since the last time."""
        entries, self.entries = self.entries, []
        return entries


def serve(connection: Connection) -> None:
    """Answer calls until the other end closes."""
    collector = _Collector()
    structlog.configure(processors=[structlog.processors.format_exc_info, collector])
    setup: Setup = connection.recv()
    session: Session | None = None
    while True:
        try:
            call: Call = connection.recv()
        except EOFError:
            break
        signal.setitimer(signal.ITIMER_REAL, call.deadline_s + ALARM_MARGIN_S)
        value, error = None, None
        try:
            if session is None:
                device = GentlDevice(setup.serial, setup.producer)
                session = Session(device, setup.serial, setup.settings)
            value = getattr(session, call.name)(*call.arguments)
        except DriverError as raised:
            error = raised.with_traceback(None)
        except Exception as raised:  # noqa: BLE001  (harvesters asserts, and raises ValueError)
            # The camera is opened again, and the log says where it was.
            _log.exception("camera_fault", serial=setup.serial, call=call.name)
            error = DeviceLostError(
                f"camera {setup.serial}: {call.name} failed: {type(raised).__name__}: {raised};"
                " it will be opened again"
            )
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        connection.send(Reply(value, error, collector.take()))
        if call.name == "release":
            break


def main() -> None:
    """Serve on the descriptor that the command line names."""
    # Ctrl-C at a terminal and systemd's stop go to all processes; this one ends with its owner.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    with Connection(int(sys.argv[1])) as connection:
        serve(connection)
    # Without the libraries' own farewell: a producer may crash or hang in it.
    os._exit(0)


if __name__ == "__main__":
    main()
