"""The page of a preview, for this machine only: seen from elsewhere through an SSH tunnel."""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from daemon.errors import HardwareError
from daemon.preview.snapshot import Snapshot

LOOPBACK = "127.0.0.1"
_PAGE = Path(__file__).with_name("page.html")
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1"})
REQUEST_TIMEOUT_S = 10.0
"""For the next byte."""
CONNECTION_LIMIT_S = 60.0
"""For a whole connection, one request: more than a picture takes through a slow tunnel."""


class Shown:
    """The latest look, from the thread that takes pairs to those that answer."""

    def __init__(self, site: str) -> None:
        self.site = site
        self._lock = threading.Lock()
        self._look: Snapshot | None = None
        self._number = 0
        self._trouble = "waiting for the first pair"

    def show(self, look: Snapshot) -> None:
        """A pair was taken."""
        with self._lock:
            self._look, self._trouble = look, ""
            self._number += 1

    def tell(self, trouble: str) -> None:
        """No pair could be taken."""
        with self._lock:
            self._trouble = trouble

    def fields(self) -> dict[str, object]:
        """What the page asks for."""
        with self._lock:
            look, trouble, number = self._look, self._trouble, self._number
        return {
            "number": number,
            "site": self.site,
            "trouble": trouble,
            "look": None if look is None else look.fields(),
        }

    def picture(self, name: str) -> bytes | None:
        """A picture of the latest look, by its file name."""
        with self._lock:
            return None if self._look is None else self._look.pictures.get(name)


@contextmanager
def serving(shown: Shown, port: int) -> Iterator[int]:
    """Answer on a port of the loopback interface while the block runs; gives the port.

    Raises HardwareError when the port is taken.
    """
    handler = type("Handler", (_Handler,), {"shown": shown})
    try:
        server = _Server((LOOPBACK, port), handler)
    except OSError as error:
        msg = f"port {port}: {error.strerror}; give another --port"
        raise HardwareError(msg) from error
    thread = threading.Thread(target=server.serve_forever, name="preview", daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Server(ThreadingHTTPServer):
    """Ends connections that take too long, so that one that trickles does not keep its thread."""

    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._begun_s: dict[Any, float] = {}
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begin to answer, in a thread of its own."""
        self._begun_s[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """The connection is done with."""
        self._begun_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Look at the connections, twice a second."""
        latest_s = time.monotonic() - CONNECTION_LIMIT_S
        for request, begun_s in self._begun_s.copy().items():
            if begun_s < latest_s:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a browser that went away, or was sent away."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Gives the page, its data and its pictures; nothing can be asked of the cameras."""

    shown: Shown
    timeout = REQUEST_TIMEOUT_S

    def do_GET(self) -> None:
        """Answer a request."""
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if host not in _LOCAL_NAMES:  # a page from elsewhere must not look through the browser
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        path = urlsplit(self.path).path
        if path == "/":
            self._give("text/html; charset=utf-8", _PAGE.read_bytes())
        elif path == "/look.json":
            self._give("application/json", json.dumps(self.shown.fields()).encode())
        elif (picture := self.shown.picture(path[1:])) is not None:
            self._give("image/png" if path.endswith(".png") else "image/jpeg", picture)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _give(self, kind: str, body: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal shows the looks."""
