"""The server: uvicorn, on a socket opened first, with limits for readers that do not read."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from daemon.errors import HardwareError

REQUEST_LIMIT_S = 10.0
"""From the connection, or the answer before, until a request is whole."""
ANSWER_LIMIT_S = 90.0
"""From a request until its answer is taken: a frame through a slow tunnel takes a minute."""
MOST_CONNECTIONS = 500
_LOOK_S = 1.0


class LimitedProtocol(H11Protocol):
    """A connection that is ended if it sends no request, or does not take its answer."""

    _watch: asyncio.TimerHandle | None = None
    _since_s: float = 0.0
    _watched: object = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to watch it."""
        super().connection_made(transport)
        self._since_s = time.monotonic()
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        """Watch it no more."""
        if self._watch is not None:
            self._watch.cancel()
        super().connection_lost(exc)

    def _look(self) -> None:
        now_s = time.monotonic()
        if self._watched is not self.cycle:  # a new request
            self._watched, self._since_s = self.cycle, now_s
        cycle = cast("RequestResponseCycle | None", self.cycle)
        done = cycle is None or cycle.response_complete
        taken = self.transport.get_write_buffer_size() == 0
        limit_s = REQUEST_LIMIT_S if done and taken else ANSWER_LIMIT_S
        if now_s - self._since_s > limit_s:
            self.transport.abort()
            return
        self._watch = self.loop.call_later(_LOOK_S, self._look)


def make_server(app: Starlette) -> uvicorn.Server:
    """A server that says nothing of requests and of itself."""
    config = uvicorn.Config(
        app,
        http=LimitedProtocol,
        ws="none",
        loop="asyncio",
        log_level="warning",
        access_log=False,
        server_header=False,
        date_header=True,
        proxy_headers=False,
        timeout_keep_alive=int(REQUEST_LIMIT_S),
        timeout_graceful_shutdown=3,
        limit_concurrency=MOST_CONNECTIONS,
        h11_max_incomplete_event_size=16_384,
    )
    return uvicorn.Server(config)


def open_socket(host: str, port: int, cure: str) -> socket.socket:
    """Listen. Raises HardwareError: what to do about a port that is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=256)
    except OSError as error:
        msg = f"port {port} of {host}: {error.strerror}; {cure}"
        raise HardwareError(msg) from error


@contextmanager
def serving(app: Starlette, host: str, port: int, cure: str) -> Iterator[int]:
    """Answer from a thread while the block runs; gives the port. Raises HardwareError."""
    listening = open_socket(host, port, cure)
    server = make_server(app)
    # Signals are for the main thread, which is the caller's.
    thread = threading.Thread(
        target=lambda: asyncio.run(server.serve([listening])), name="page", daemon=True
    )
    thread.start()
    try:
        yield int(cast("tuple[Any, int]", listening.getsockname()[:2])[1])
    finally:
        server.should_exit = True
        thread.join(10.0)
        listening.close()
