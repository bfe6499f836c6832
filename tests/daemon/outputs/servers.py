"""A real MQTT broker, a wire that can be cut, and an HTTP server that keeps points."""

from __future__ import annotations

import gzip
import shutil
import socket
import socketserver
import ssl
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.waiting import wait_for

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin")


def free_port() -> int:
    """A port of loopback that nobody listens at."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    with closing(socket.socket()) as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@dataclass(frozen=True)
class Identity:
    """A key and a certificate of `127.0.0.1` that it signed itself: its own authority, too."""

    certificate: Path
    key: Path

    @classmethod
    def make(cls, directory: Path, name: str) -> Identity:
        made = cls(directory / f"{name}.pem", directory / f"{name}.key")
        words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2"
        subject = f"-subj /CN={name} -addext subjectAltName=IP:127.0.0.1"
        files = ["-out", made.certificate, "-keyout", made.key]
        command = ["openssl", *words.split(), *subject.split(), *files]
        subprocess.run(command, check=True, capture_output=True)
        return made


class Broker:
    """Debian's mosquitto, with a memory on the disk."""

    def __init__(self, directory: Path, more: str = "") -> None:
        if MOSQUITTO is None:
            pytest.skip("mosquitto is not installed: .ci/system-packages installs it")
        self.port = free_port()
        self._log = directory / "mosquitto.log"
        self._config = directory / "mosquitto.conf"
        access = "" if "password_file" in more else "allow_anonymous true\n"
        user = "user root\n" if Path.home() == Path("/root") else ""
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\n{access}{user}persistence true\n"
            f"persistence_location {directory}/\nmax_queued_messages 0\n{more}"
        )
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [str(MOSQUITTO), "-c", str(self._config)], stdout=log, stderr=log
            )
        wait_for(self._is_up, "the broker")

    def _is_up(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, self._log.read_text()
        return listens(self.port)

    def stop(self) -> None:
        """End it in order: it writes down what it has to deliver."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    def restart(self) -> None:
        self.stop()
        self.start()


class Wire:
    """A TCP proxy in front of a port; its connections can be cut at any moment."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._sockets: set[socket.socket] = set()
        self._lock = threading.Lock()
        self.passed = 0
        """Bytes, both ways: moments to cut at that do not depend on the clock."""
        wire = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                wire._carry(self.request)

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = True

        self._server = Server(("127.0.0.1", 0), Handler)
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _carry(self, near: socket.socket) -> None:
        try:
            far = socket.create_connection(("127.0.0.1", self._target))
        except OSError:
            return
        with self._lock:
            self._sockets |= {near, far}
        back = threading.Thread(target=self._pump, args=(far, near), daemon=True)
        back.start()
        self._pump(near, far)
        back.join()
        with self._lock:
            self._sockets -= {near, far}
        for end in (near, far):
            end.close()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(4096):
                sink.sendall(data)
                with self._lock:
                    self.passed += len(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        """Sever every connection; new ones may be made."""
        with self._lock:
            for end in self._sockets:
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self.cut()


Trouble = Callable[[BaseHTTPRequestHandler], bool]
"""What goes wrong with a request after it was stored: it answers itself, or not at all."""


class Points:
    """A server for line protocol, as strict about a point as InfluxDB: its key names it."""

    def __init__(self, identity: Identity | None = None) -> None:
        self.identity = identity
        """With it the server speaks TLS."""
        self.bodies: list[str] = []
        self.requests: list[tuple[str, dict[str, str]]] = []
        self.refuse: list[int] = []
        """Answers of the next requests, which are not stored."""
        self.forget_to_answer = 0
        """How many of the next requests are stored, and then get no answer."""
        self.port = free_port()
        self._server: ThreadingHTTPServer | None = None
        self.start()

    def start(self) -> None:
        points = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                points.requests.append((self.path, dict(self.headers)))
                if points.refuse:
                    self.send_response(points.refuse.pop(0))
                    self.send_header("Content-Length", "9")
                    self.end_headers()
                    self.wfile.write(b"try later")
                    return
                points.bodies.append(gzip.decompress(body).decode())
                if points.forget_to_answer:
                    points.forget_to_answer -= 1
                    self.connection.shutdown(socket.SHUT_RDWR)
                    return
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_arguments: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        if self.identity is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(self.identity.certificate, self.identity.key)
            self._server.socket = context.wrap_socket(self._server.socket, server_side=True)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def stop(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    @property
    def lines(self) -> list[str]:
        """Every line that was stored, repeats too."""
        return [line for body in self.bodies for line in body.splitlines()]


@contextmanager
def points_server(identity: Identity | None = None) -> Iterator[Points]:
    """A server that runs during the block."""
    points = Points(identity)
    try:
        yield points
    finally:
        points.stop()
