"""Receivers that alarms reach for real: a mail server and a web server on loopback, a program."""

from __future__ import annotations

import email
import email.message
import json
import re
import sys
import threading
from collections.abc import Iterator
from datetime import datetime, timedelta
from email import policy
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiosmtpd.controller import Controller

from core.results import Displacement, Flag, Measurement, Reason, RigMotion
from daemon.lock import sole_writer
from tests.daemon.commands.conftest import MINUTE, SIMULATED, Ran, Site, ctl, site

__all__ = ["ctl", "site"]


class WebServer:
    """What Apprise's `json://` talks to."""

    def __init__(self) -> None:
        self.messages: list[dict[str, str]] = []
        self.status = 200
        box = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if box.status == 200:
                    box.messages.append(json.loads(body))
                self.send_response(box.status)
                self.end_headers()

            def log_message(self, *_words: object) -> None:
                """Say nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"json://127.0.0.1:{self.server.server_port}"

    def titles(self) -> list[str]:
        return [message["title"] for message in self.messages]

    def texts(self) -> list[str]:
        return [message["message"] for message in self.messages]


@pytest.fixture
def web() -> Iterator[WebServer]:
    """A web server that takes messages."""
    made = WebServer()
    thread = threading.Thread(target=made.server.serve_forever)
    thread.start()
    yield made
    made.server.shutdown()
    made.server.server_close()
    thread.join()


class OnFreePort(Controller):
    """Finds its port out before it tries whether it answers there."""

    def _trigger_server(self) -> None:
        self.port = self.server.sockets[0].getsockname()[1]
        super()._trigger_server()


class MailServer:
    """An SMTP server that keeps what it is sent."""

    def __init__(self) -> None:
        self.mails: list[email.message.EmailMessage] = []
        self.controller = OnFreePort(self, hostname="127.0.0.1", port=0)

    async def handle_DATA(self, _server: Any, _session: Any, envelope: Any) -> str:
        self.mails.append(email.message_from_bytes(envelope.content, policy=policy.default))
        return "250 taken"

    @property
    def url(self) -> str:
        words = "mode=insecure&from=pier@example.org&to=me@example.org&smtp=127.0.0.1"
        return f"mailto://127.0.0.1:{self.controller.port}/?{words}"


@pytest.fixture
def mail() -> Iterator[MailServer]:
    """A mail server."""
    made = MailServer()
    made.controller.start()
    yield made
    made.controller.stop()


class Program:
    """A program of the site's own that appends each message to a file."""

    def __init__(self, directory: Path) -> None:
        self.inbox = directory / "inbox"
        self._script = directory / "modem.py"
        self.write("")

    @property
    def command(self) -> str:
        return json.dumps([sys.executable, "-I", "-S", str(self._script)])  # begins sooner

    def write(self, after: str, before: str = "") -> None:
        """Have it do more, before or after it has taken a message."""
        take = f"open({str(self.inbox)!r}, 'a').write(sys.stdin.read() + '\\0')"
        lines = ["import os, signal, sys", before, take, after]
        self._script.write_text("\n".join(lines) + "\n")

    def messages(self) -> list[str]:
        return self.inbox.read_text().split("\0")[:-1] if self.inbox.exists() else []

    def titles(self) -> list[str]:
        return [message.splitlines()[0] for message in self.messages()]


@pytest.fixture
def program(tmp_path: Path) -> Program:
    """A program that takes messages."""
    return Program(tmp_path)


LOW = """
[[alarm.value]]
name = "midspan-low"
below_mm = -10.0
"""


def configure(site: Site, alarm: str, extra: str = "") -> None:
    """Give the site an `[alarm]` section."""
    site.config.write_text(f"{SIMULATED}\n{extra}\n[alarm]\n{alarm}\n")


def row(
    y_mm: float, sigma_mm: float = 0.1, flag: Flag = Flag.GOOD, *reasons: Reason
) -> Measurement:
    """A row with a value of y."""
    value = Displacement(np.array([0.5, y_mm]), np.eye(2) * sigma_mm**2)
    return Measurement(flag, reasons, value, value, RigMotion(np.zeros(3), np.zeros(3), np.eye(6)))


def words(site: Site, late: timedelta = timedelta(0)) -> list[str]:
    """The arguments of a look some seconds after the newest row."""
    return ["--at", (site.end - MINUTE + timedelta(seconds=20) + late).isoformat()]


def look(site: Site, late: timedelta = timedelta(0)) -> Ran:
    """One look, beside a dcamd that holds the lock."""
    with sole_writer(site.state):
        return site.ctl("alarm", *words(site, late))


def history(site: Site) -> list[dict[str, str]]:
    """What `alarm history` says."""
    found: list[dict[str, str]] = json.loads(site.ctl("alarm", "history", "--json").out)["history"]
    return found


def listed(site: Site, late: timedelta = timedelta(0)) -> dict[str, dict[str, Any]]:
    """What `alarm list` says, by name."""
    document = json.loads(site.ctl("alarm", "list", "--json", *words(site, late)).out)
    return {one["name"]: one for one in document["alarms"]}


def number_of(message: str) -> str:
    """The number of a message, by which a receiver can tell a second copy."""
    found = re.search(r"\(message ([0-9a-f]{8})", message)
    assert found, message
    return found[1]


def moment(text: str) -> datetime:
    return datetime.fromisoformat(text)
