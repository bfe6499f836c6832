"""The ports that a head can be at, opened by pyserial: a local one, or one behind the network."""

from __future__ import annotations

import errno
import select
import socket
import time
from contextlib import suppress
from typing import Any, Protocol

import serial

from drivers.errors import HeadLostError
from drivers.heads.port_name import is_network

RFC2217_POLL_S = 0.02
"""pyserial reads a serial server in a thread of its own, and that can only be polled."""
NETWORK_DEAD_S = 8
"""A connection that acknowledges nothing for so long is dead, though nobody has closed it."""
READ_BYTES = 4096


class Port(Protocol):
    """An open port. Every call raises OSError when it is lost."""

    def write(self, data: bytes) -> None:
        """Send all; serial.SerialTimeoutException when it takes no bytes."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """Give what has come, waiting for the first byte no longer than given; else b""."""
        ...

    def close(self) -> None:
        """Release it; bytes not sent yet are dropped."""
        ...


class LocalPort:
    """A serial port of this computer, which nobody else can open meanwhile; implements `Port`."""

    def __init__(self, name: str, baud: int, write_timeout_s: float) -> None:
        try:
            self._port = serial.Serial(
                name, baud, timeout=0, write_timeout=write_timeout_s, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise HeadLostError(_why_no_local(name, error)) from None
        self._port.reset_input_buffer()

    def write(self, data: bytes) -> None:
        """Send all."""
        self._port.write(data)

    def read(self, timeout_s: float) -> bytes:
        """Give what has come within the time."""
        if not select.select([self._port.fileno()], [], [], max(timeout_s, 0.0))[0]:
            return b""
        return bytes(self._port.read(READ_BYTES))

    def close(self) -> None:
        """Release it, and drop what an adapter does not take: the kernel would wait 30 s for it."""
        with suppress(OSError, TypeError):
            self._port.reset_output_buffer()
        with suppress(OSError, TypeError):
            self._port.close()


class NetworkPort:
    """A port behind the network, by pyserial's URL; implements `Port`.

    `socket://HOST:PORT` carries the bytes alone (heads with Ethernet, device servers in raw mode;
    the baud rate is set there), `rfc2217://HOST:PORT` sets the baud rate of a serial server too.
    """

    def __init__(self, url: str, baud: int, write_timeout_s: float) -> None:
        self._is_raw = url.startswith("socket:")
        # pyserial's RFC 2217 takes no time-out for writing: its socket has one, 5 s.
        waits: dict[str, float] = {"timeout": 0.0 if self._is_raw else RFC2217_POLL_S}
        if self._is_raw:
            waits["write_timeout"] = write_timeout_s
        try:
            self._port: Any = serial.serial_for_url(url, baud, **waits)
        except (OSError, ValueError) as error:
            raise HeadLostError(_why_no_network(url, error)) from None
        # pyserial has no other way to its connection.
        self._connection: socket.socket = self._port._socket  # noqa: SLF001
        with suppress(OSError):  # hung up already, as the first call will find
            _die_when_dead(self._connection)
        self._probe = self._connection.dup()
        self._probe.settimeout(0.0)

    def write(self, data: bytes) -> None:
        """Send all."""
        self._port.write(data)

    def read(self, timeout_s: float) -> bytes:
        """Give what has come within the time."""
        until_s = time.monotonic() + timeout_s
        if self._is_raw:
            if not select.select([self._port.fileno()], [], [], max(timeout_s, 0.0))[0]:
                return b""
            return bytes(self._port.read(READ_BYTES))
        while True:
            heard = bytes(self._port.read(max(self._port.in_waiting, 1)))
            if not heard:
                self._require_connected()
            if heard or time.monotonic() >= until_s:
                return heard

    def close(self) -> None:
        """Release it; pyserial does not close a connection that the other end has left."""
        with suppress(OSError, TypeError, AttributeError):
            self._port.close()
        self._connection.close()
        self._probe.close()

    def _require_connected(self) -> None:
        """Raise OSError when the other end has hung up: pyserial's thread may see it too late."""
        with suppress(BlockingIOError):
            if not self._probe.recv(1, socket.MSG_PEEK):
                raise ConnectionResetError(errno.ECONNRESET, "the other end hung up")


def open_port(name: str, baud: int, write_timeout_s: float) -> Port:
    """Open a port by its name. Raises HeadLostError that says why not and what to do."""
    if is_network(name):
        return NetworkPort(name, baud, write_timeout_s)
    return LocalPort(name, baud, write_timeout_s)


def _die_when_dead(connection: socket.socket) -> None:
    """Have the kernel notice a cable that is out: TCP by itself would wait for many minutes."""
    for option, value in (
        (socket.TCP_NODELAY, 1),
        (socket.TCP_KEEPIDLE, NETWORK_DEAD_S // 2),
        (socket.TCP_KEEPINTVL, 1),
        (socket.TCP_KEEPCNT, NETWORK_DEAD_S // 2),
        (socket.TCP_USER_TIMEOUT, 1000 * NETWORK_DEAD_S),
    ):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)


def why_too_slow(name: str, waited_s: float) -> str:
    """Say what to do about a port that does not open in time."""
    if is_network(name):
        return f"{name}: no answer within {waited_s:g} s; {CHECK_NETWORK}"
    return f"{name}: did not open within {waited_s:g} s; replug the adapter"


def why_gone(name: str, error: Exception) -> str:
    """Say what to do about a port that was lost."""
    if is_network(name):
        return (
            f"{name}: the connection was lost ({error}); check its power, the network between, and "
            "that no other program uses the head"
        )
    return f"{name}: the port has vanished ({error}); check cable and adapter"


CHECK_NETWORK = "check its power, the network between, and the address in pan_tilt.port"


def _why_no_local(name: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return f"{name}: no such port; check cable and power, see ls /dev/serial/by-id"
    if number in {errno.EACCES, errno.EPERM}:
        return f"{name}: no permission; add the user to the group dialout"
    if number in {errno.EAGAIN, errno.EBUSY} or "exclusively lock" in str(error):
        return f"{name}: in use by another program; end that first"
    return f"{name}: cannot be opened as a serial port ({error}); check pan_tilt.port"


def _why_no_network(url: str, error: Exception) -> str:
    cause = error.__context__ or error  # pyserial keeps no error number of the socket's
    if isinstance(cause, ConnectionRefusedError):
        return (
            f"{url}: the host is there, but refuses the connection; check the port number, that "
            "its server is set to TCP, and that no other program has the head"
        )
    if isinstance(cause, socket.gaierror):
        return f"{url}: no such host name; give its IP address in pan_tilt.port, or check the DNS"
    if isinstance(cause, TimeoutError) or getattr(cause, "errno", None) in {
        errno.EHOSTUNREACH,
        errno.ENETUNREACH,
        errno.EHOSTDOWN,
    }:
        return f"{url}: nobody answers at this address; {CHECK_NETWORK}"
    if "RFC2217" in str(error):
        return (
            f"{url}: what answers there does not speak RFC 2217; set the server to it, or use "
            "socket:// with the baud rate set at the server"
        )
    return f"{url}: cannot be opened ({error}); {CHECK_NETWORK}"
