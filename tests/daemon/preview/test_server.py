"""The preview's page holds no thread for a connection that never gets to its end."""

from __future__ import annotations

import socket
import threading
import urllib.request

import pytest

from daemon.preview import server
from daemon.preview.server import Shown, serving
from tests.waiting import PATIENCE_S, wait_for


def test_a_connection_that_trickles_is_ended(monkeypatch: pytest.MonkeyPatch, capfd) -> None:
    monkeypatch.setattr(server, "CONNECTION_LIMIT_S", 0.2)
    before = threading.active_count()
    with serving(Shown("pier"), 0) as port:
        with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as slow:
            slow.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")

            def is_ended() -> bool:
                try:
                    slow.sendall(b"x")  # each within the time for the next byte
                except OSError:
                    return True
                return False

            wait_for(is_ended, "the end of the connection")
        wait_for(lambda: threading.active_count() == before + 1, "the end of its thread")
        with urllib.request.urlopen(f"http://localhost:{port}/", timeout=PATIENCE_S) as answer:
            assert b"<title>" in answer.read()
    assert capfd.readouterr().err == ""
