"""A serial line with a deadline on every call, opened again once its port is back."""

from __future__ import annotations

import errno
import select
import threading
import time
from contextlib import suppress
from typing import Any, Protocol

import serial

from drivers.deadline import DeadlineExceededError, DeadlineThread
from drivers.errors import HeadLostError

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
    """A serial port by its name, best one below /dev/serial/by-id; implements `Line`.

    8 data bits, no parity, 1 stop bit, no flow control. Nobody else can open the port meanwhile.
    """

    def __init__(
        self, port: str, baud: int, *, call_timeout_s: float = 5.0, reopen_s: float = 5.0
    ) -> None:
        self._port_name = port
        self._baud = baud
        self._call_timeout_s = call_timeout_s
        self._reopen_s = reopen_s
        self._port: Any = None
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
            except HeadLostError:
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
            msg = f"{self.name}: takes no bytes; check cable and adapter"
            raise HeadLostError(msg) from None
        except (OSError, TypeError) as error:  # TypeError: closed by another thread meanwhile
            raise self._gone(error) from None

    def read(self, timeout_s: float) -> bytes:
        """Give what has come within the time, b"" if nothing. Raises HeadLostError."""
        port = self._present()
        try:
            if not select.select([port.fileno()], [], [], max(timeout_s, 0.0))[0]:
                return b""
            return bytes(port.read(4096))
        except (OSError, TypeError, ValueError) as error:
            raise self._gone(error) from None

    def close(self) -> None:
        """Release the port; bytes not sent yet are dropped."""
        with self._lock:
            port, self._port = self._port, None
        if port is not None:
            # The kernel may wait half a minute for bytes that an adapter does not take.
            thread = DeadlineThread("serial-close", at_end=lambda: None)
            thread.submit(lambda: _close(port))
            thread.end(self._call_timeout_s)

    def _present(self) -> Any:
        port = self._port
        if port is None:
            msg = f"{self.name}: not open; the port was lost"
            raise HeadLostError(msg)
        return port

    def _opened(self) -> Any:
        """Open the port in a thread of its own, for a driver of the kernel may hang."""
        opened: list[Any] = []
        late = threading.Event()

        def open_port() -> None:
            port = serial.Serial(
                self._port_name,
                self._baud,
                timeout=0,
                write_timeout=self._call_timeout_s,
                exclusive=True,
            )
            port.reset_input_buffer()
            opened.append(port)

        def at_end() -> None:
            if late.is_set():
                for port in opened:
                    _close(port)

        thread = DeadlineThread("serial-open", at_end)
        try:
            thread.call(open_port, self._call_timeout_s)
        except DeadlineExceededError:
            late.set()
            msg = f"{self.name}: did not open within {self._call_timeout_s:g} s; replug the adapter"
            raise HeadLostError(msg) from None
        except (OSError, ValueError) as error:
            raise HeadLostError(self._why(error)) from None
        finally:
            thread.end()
        return opened[0]

    def _why(self, error: Exception) -> str:
        """Say why a port cannot be opened, and what to do."""
        number = getattr(error, "errno", None)
        if number in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
            return f"{self.name}: no such port; check cable and power, see ls /dev/serial/by-id"
        if number in {errno.EACCES, errno.EPERM}:
            return f"{self.name}: no permission; add the user to the group dialout"
        if number in {errno.EAGAIN, errno.EBUSY} or "exclusively lock" in str(error):
            return f"{self.name}: in use by another program; end that first"
        return f"{self.name}: cannot be opened as a serial port ({error}); check pan_tilt.port"

    def _gone(self, error: Exception) -> HeadLostError:
        self.close()
        msg = f"{self.name}: the port has vanished ({error}); check cable and adapter"
        return HeadLostError(msg)


def _close(port: Any) -> None:
    with suppress(OSError, TypeError):
        port.reset_output_buffer()
    with suppress(OSError, TypeError):
        port.close()
