"""What dcamd tells systemd: ready, status, alive, stopping (sd_notify(3)), without a library."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends states to the service manager; without one it does nothing.

    A service manager that does not listen must never stop a measurement, so errors of the
    socket are dropped: systemd notices by itself what is missing.
    """

    def __init__(self, address: str | None, watchdog_s: float | None = None) -> None:
        """`watchdog_s` is how long the service manager waits for a cycle; None: for ever."""
        self._address = address
        self._watchdog_s = watchdog_s

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] = os.environ) -> Notifier:
        """Take them from NOTIFY_SOCKET and WATCHDOG_USEC (sd_watchdog_enabled(3))."""
        watchdog_us = environ.get("WATCHDOG_USEC", "")
        of_us = environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_s = 1e-6 * int(watchdog_us) if of_us and watchdog_us.isdecimal() else 0.0
        return cls(environ.get("NOTIFY_SOCKET") or None, watchdog_s or None)

    def start_takes(self, seconds: float) -> None:
        """Start-up goes on, and may take so long from now."""
        self._send(f"EXTEND_TIMEOUT_USEC={1e6 * seconds:.0f}")

    def cycles_take(self, seconds: float) -> None:
        """Have the watchdog wait so long for a cycle, if there is one that waits for less."""
        if self._watchdog_s is not None and self._watchdog_s < seconds:
            self._send(f"WATCHDOG_USEC={1e6 * seconds:.0f}")

    def ready(self) -> None:
        """Start-up is over: the next slot will be taken."""
        self._send("READY=1")

    def stopping(self) -> None:
        """The daemon ends its slot and closes."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """Set the line that `systemctl status` shows."""
        self._send(f"STATUS={' '.join(text.split())}")

    def alive(self, text: str) -> None:
        """Set the status line to the cycle that has ended, and feed the watchdog because it has."""
        self.status(text)
        self._send("WATCHDOG=1")

    def _send(self, state: str) -> None:
        if self._address is None:
            return
        # An address that begins with @ is abstract: in the kernel a NUL stands for it.
        abstract = self._address.startswith("@")
        address = f"\0{self._address[1:]}" if abstract else self._address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)
            try:
                channel.sendto(state.encode(), address)
            except OSError:
                return
