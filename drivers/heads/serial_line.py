"""A line to a head with a deadline on every call, opened again once its port is back."""

from __future__ import annotations

import threading
import time
from typing import Protocol

import serial

from drivers.deadline import DeadlineExceededError, DeadlineThread
from drivers.errors import HeadLostError, HeadUnreachedError
from drivers.heads.port_name import is_network
from drivers.heads.ports import Port, open_port, why_gone, why_too_slow

NETWORK_CALL_TIMEOUT_S = 15.0
"""pyserial waits 5 s for a connection, and 3 s for each answer of a serial server."""
LOOK_AGAIN_S = 0.1
"""Between two looks for a port that has vanished."""


class Line(Protocol):
    """Bytes to and from a head, and the time in which they travel."""

    @property
    def name(self) -> str:
        """Which port, for messages."""
        ...

    @property
    def openings(self) -> int:
        """How often the line was opened: another number means another conversation."""
        ...

    def monotonic_s(self) -> float:
        """Seconds that never step."""
        ...

    def open(self) -> None:
        """Open the port unless it is open. Raises HeadLostError."""
        ...

    def write(self, data: bytes) -> None:
        """Send. Raises HeadLostError."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """Give what has come, waiting for the first byte no longer than given; else b"".

        Raises HeadLostError.
        """
        ...

    def close(self) -> None:
        """Release the port; safe to call more than once."""
        ...


class SerialLine:
    """A serial port by its name, or one behind the network by its URL; implements `Line`.

    A name is best one below /dev/serial/by-id; nobody else can open that port meanwhile. A URL is
    `socket://HOST:PORT` or `rfc2217://HOST:PORT`. 8 data bits, no parity, 1 stop bit, no flow
    control.
    """

    def __init__(
        self, port: str, baud: int, *, call_timeout_s: float | None = None, reopen_s: float = 5.0
    ) -> None:
        self._port_name = port
        self._baud = baud
        default_s = NETWORK_CALL_TIMEOUT_S if is_network(port) else 5.0
        self._call_timeout_s = default_s if call_timeout_s is None else call_timeout_s
        self._reopen_s = reopen_s
        self._port: Port | None = None
        self._openings = 0
        self._lock = threading.Lock()

    @property
    def name(self) -> str:
        """The port's name as configured."""
        return self._port_name

    @property
    def openings(self) -> int:
        """How often the port was opened."""
        return self._openings

    def monotonic_s(self) -> float:
        """The machine's own monotonic clock: a real head moves in real time."""
        return time.monotonic()

    def open(self) -> None:
        """Open the port unless it is open.

        One that was open before and has vanished is waited for, `reopen_s` at most: an adapter
        that is plugged in again takes a second or two. Raises HeadLostError.
        """
        if self._port is not None:
            return
        deadline_s = time.monotonic() + (self._reopen_s if self._openings else 0.0)
        while True:
            try:
                self._port = self._opened()
            except HeadLostError as error:
                if not self._openings:
                    raise HeadUnreachedError(str(error)) from None
                if time.monotonic() >= deadline_s:
                    raise
                time.sleep(LOOK_AGAIN_S)
            else:
                self._openings += 1
                return

    def write(self, data: bytes) -> None:
        """Send all bytes within the deadline. Raises HeadLostError."""
        port = self._present()
        try:
            port.write(data)
        except serial.SerialTimeoutException:
            self.close()
            way = "the network between" if is_network(self.name) else "cable and adapter"
            msg = f"{self.name}: takes no bytes; check {way}"
            raise HeadLostError(msg) from None
        except (
            OSError,
            TypeError,
            AttributeError,
        ) as error:  # the latter: closed by another thread
            raise self._gone(error) from None

    def read(self, timeout_s: float) -> bytes:
        """Give what has come within the time, b"" if nothing. Raises HeadLostError."""
        port = self._present()
        try:
            return port.read(timeout_s)
        except (OSError, TypeError, ValueError, AttributeError) as error:
            raise self._gone(error) from None

    def close(self) -> None:
        """Release the port; bytes not sent yet are dropped."""
        with self._lock:
            port, self._port = self._port, None
        if port is not None:
            thread = DeadlineThread("serial-close", at_end=lambda: None)
            thread.submit(port.close)
            thread.end(self._call_timeout_s)

    def _present(self) -> Port:
        port = self._port
        if port is None:
            msg = f"{self.name}: not open; the line was lost"
            raise HeadLostError(msg)
        return port

    def _opened(self) -> Port:
        """Open the port in a thread of its own, for a driver of the kernel may hang."""
        opened: list[Port] = []
        late = threading.Event()

        def open_now() -> None:
            opened.append(open_port(self._port_name, self._baud, self._call_timeout_s))

        def at_end() -> None:
            if late.is_set():
                for port in opened:
                    port.close()

        thread = DeadlineThread("serial-open", at_end)
        try:
            thread.call(open_now, self._call_timeout_s)
        except DeadlineExceededError:
            late.set()
            raise HeadLostError(why_too_slow(self.name, self._call_timeout_s)) from None
        finally:
            thread.end()
        return opened[0]

    def _gone(self, error: Exception) -> HeadLostError:
        self.close()
        return HeadLostError(why_gone(self.name, error))
