"""The page of a preview, for this machine only: seen from elsewhere through an SSH tunnel."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

from daemon.errors import HardwareError
from daemon.preview.snapshot import Snapshot

LOOPBACK = "127.0.0.1"
_PAGE = Path(__file__).with_name("page.html")
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1"})
REQUEST_TIMEOUT_S = 10.0


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
        server = ThreadingHTTPServer((LOOPBACK, port), handler)
    except OSError as error:
        msg = f"port {port}: {error.strerror}; give another --port"
        raise HardwareError(msg) from error
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, name="preview", daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


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
