"""A head behind the network: a bridge from TCP to the port of a simulated head."""

from __future__ import annotations

import select
import socket
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

import serial
from serial.rfc2217 import PortManager

from tests.waiting import PATIENCE_S

TICK_S = 0.02


class PseudoTerminal(serial.Serial):
    """Has no control lines, which a serial server sets and watches on its port."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass


class Connection:
    """What `PortManager` writes its own answers to."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client

    def write(self, data: bytes) -> None:
        self._client.sendall(data)


class Bridge:
    """Serves one client at a time, the bytes alone or as RFC 2217 says; `drop` hangs up on it."""

    def __init__(self, head_port: Path, *, rfc2217: bool = False, number: int = 0) -> None:
        self._head = PseudoTerminal(str(head_port), 9600, timeout=0)
        self._rfc2217 = rfc2217
        self._listener = socket.create_server(("127.0.0.1", number))
        self._client: socket.socket | None = None
        self._manager: PortManager | None = None
        self._stop, self._drop, self._dropped = (threading.Event() for _ in range(3))
        self._thread = threading.Thread(target=self._serve, daemon=True)

    @property
    def number(self) -> int:
        number: int = self._listener.getsockname()[1]
        return number

    @property
    def url(self) -> str:
        return f"{'rfc2217' if self._rfc2217 else 'socket'}://127.0.0.1:{self.number}"

    @property
    def baud(self) -> int:
        """As the client has set it."""
        baud: int = self._head.baudrate
        return baud

    def drop(self) -> None:
        """Hang up on the client; it may call again."""
        self._dropped.clear()
        self._drop.set()
        assert self._dropped.wait(PATIENCE_S)

    def close(self) -> None:
        """Hang up, and answer nobody any more."""
        self._stop.set()
        self._thread.join()
        self._listener.close()
        self._head.close()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            if self._drop.is_set():
                self._drop.clear()
                self._hang_up()
                self._dropped.set()
            watched = [self._listener, self._head.fileno()]
            ready, _, _ = select.select(
                [*watched, self._client] if self._client else watched, [], [], TICK_S
            )
            try:
                self._pass_on(ready)
            except ConnectionError:  # the client's end of it
                self._hang_up()
        self._hang_up()

    def _pass_on(self, ready: list[object]) -> None:
        if self._client is not None and self._client in ready:
            data = self._client.recv(4096)
            if not data:
                self._hang_up()
                return
            self._head.write(b"".join(self._manager.filter(data)) if self._manager else data)
        if self._head.fileno() in ready:
            data = self._head.read(4096)
            if self._client is not None:
                self._client.sendall(
                    b"".join(self._manager.escape(data)) if self._manager else data
                )
        if self._listener in ready and self._client is None:
            self._client, _ = self._listener.accept()
            if self._rfc2217:
                self._manager = PortManager(self._head, Connection(self._client))

    def _hang_up(self) -> None:
        client, self._client, self._manager = self._client, None, None
        if client is not None:
            client.close()
