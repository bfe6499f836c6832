"""Who is answered, and what is never given."""

from __future__ import annotations

import contextlib
import json
import socket
from pathlib import Path

import pytest

from daemon.store.database import open_store
from daemon.web import serving
from tests.daemon.store.examples import record, slot
from tests.daemon.web.site import Browser, page
from tests.waiting import PATIENCE_S

TOKEN = "0123456789abcdef0123"
NAME = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory):
    """A page without a token; a row that names a file which is none of the archive's."""
    from dataclasses import replace

    directory = tmp_path_factory.mktemp("plain")
    with open_store(directory / "state") as store:
        for number, name in enumerate(
            ("../dcam.toml", "dcam.db", "frames/../../secret.png", "frames/link.png", "/etc/passwd")
        ):
            store.add_measurement(replace(record(slot(number)), main_frame=name, sub_frame=name))
    (directory / "secret.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(20))
    (directory / "state" / "frames").mkdir()
    (directory / "state" / "frames" / "link.png").symlink_to(directory / "secret.png")
    with page(directory) as browser:
        yield browser


@pytest.mark.parametrize(
    "host", ["bridge.example", "localhost.example", "127.0.0.1.example:80", "", "[::2]", "a\tb"]
)
def test_other_hosts_are_refused(plain: Browser, host: str) -> None:
    for path in ("/", "/api/overview", "/static/page.js"):
        assert plain(path, Host=host).status in {400, 403}


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1234", "127.0.0.1:9", "[::1]:8766"])
def test_this_machine_is_answered_through_any_tunnel(plain: Browser, host: str) -> None:
    assert plain("/api/overview", Host=host).status == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_nothing_can_be_written(plain: Browser, method: str) -> None:
    for path in ("/", "/api/overview", "/login"):
        assert plain(path, method).status == 405


@pytest.mark.parametrize("number", range(5))
def test_no_file_but_the_archives_is_given(plain: Browser, number: int) -> None:
    time = slot(number).isoformat().replace("+00:00", "Z")
    for role in ("main", "sub"):
        answer = plain(f"/frames/{time}/{role}")
        assert answer.status == 404
        assert "is not kept" in answer.error
    assert plain(f"/api/slot/{time}").json["frames"] == {"main": None, "sub": None}


@pytest.mark.parametrize(
    "path",
    [
        *("/static/../app.py", "/static/%2e%2e/app.py", "/static/..%2fapp.py", "//etc/passwd"),
        *(
            "/frames/../dcam.db",
            "/frames/2026-03-01T00:00:00Z/../../dcam.db",
            "/static//etc/passwd",
        ),
        *("/%00", "/api/", "/frames/2026-03-01T00:00:00Z/other", "/aim/..%2f..%2fapp.py"),
    ],
)
def test_hostile_paths_find_nothing(plain: Browser, path: str) -> None:
    answer = plain(path)
    assert answer.status in {400, 404}
    assert b"import" not in answer.body
    assert b"SQLite" not in answer.body


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/api/series?quantities=x_mm.main;drop", "quantities: 'x_mm.main;drop' is none"),
        ("/api/series?quantities=" + ",".join(f"a{k}" for k in range(65)), "quantities: name 1 to"),
        ("/api/series?quantities=../flags", "quantities"),
        ("/api/series?buckets=1e9", "buckets: must be a number from 1 to 8000"),
        ("/api/series?buckets=nan", "buckets"),
        ("/api/series?since=2026-03-02&until=2026-03-01", "since: must be before until"),
        ("/api/series?since=soon", "since: 'soon' is no time"),
        ("/api/series?sort=1", "unknown parameter 'sort'"),
        ("/api/series?buckets=1&buckets=2", "buckets: given twice"),
        ("/api/spans?since=2026-03-01&until=inf", "until: 'inf' is no time"),
        ("/api/days?since=1970-01-01&until=2199-01-01", "at most 400 days"),
        ("/api/analysis?axis=z", "axis: x or y"),
        ("/api/analysis?point=nowhere", "point nowhere: no measured point of this name"),
        ("/api/slot/%27%20OR%201=1", "is no time"),
        ("/frames/2026-03-01T00:00:00Z/main?width=100000", "width"),
    ],
)
def test_what_is_asked_wrongly_is_one_line(plain: Browser, path: str, said: str) -> None:
    answer = plain(path)
    assert answer.status == 400
    assert (said in answer.error, "\n" in answer.error) == (True, False)


def test_every_answer_forbids_scripts_from_elsewhere(plain: Browser) -> None:
    for path in ("/", "/api/overview", "/nothing", "/static/page.js", "/api/series?sort=1"):
        headers = plain(path).headers
        assert headers["content-security-policy"].startswith("default-src 'self'")
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers


def test_a_long_address_is_refused(plain: Browser) -> None:
    assert plain("/api/series?quantities=" + "x" * 5000).status == 414


def test_a_name_with_markup_is_a_name(tmp_path: Path) -> None:
    config = tmp_path / "dcam.toml"
    with page(tmp_path) as browser:
        del browser
    text = config.read_text()
    with page(tmp_path, "") as browser:
        name = browser("/api/overview").json["site"]
    named = text.replace(f'name = "{name}"', f"name = '{NAME}'")
    assert NAME in named
    from dataclasses import replace

    from daemon.config.reading import find_installation
    from daemon.web.app import build_app
    from daemon.web.settings import settings_of

    config.write_text(named)
    settings = settings_of(find_installation(config, tmp_path / "state"))
    app = build_app(replace(settings, cache=tmp_path / "cache"))
    with serving.serving(app, "127.0.0.1", 0, "") as port:
        browser = Browser(port)
        for path in ("/", "/days", "/events", "/aim", "/calibrations", "/nothing"):
            body = browser(path, Accept="text/html").body
            assert b"&lt;script&gt;alert(1)" in body
            assert NAME.encode() not in body
        assert browser("/api/overview").json["site"] == NAME


def test_the_token_opens_and_nothing_else_does(tmp_path: Path) -> None:
    wide = f'[web]\nhost = "0.0.0.0"\ntoken = "{TOKEN}"\nhosts = ["pier-3", "10.0.0.3"]\n'
    with page(tmp_path, wide) as browser:

        def ask(path: str, **headers: str) -> int:
            return browser(path, Host="pier-3:8766", **headers).status

        assert browser("/", Host="localhost").status == 403
        assert ask("/api/overview") == 401
        assert ask("/frames/2026-03-01T00:00:00Z/main") == 401
        assert ask("/api/overview", Authorization=f"Bearer {TOKEN}") == 200
        assert ask("/api/overview", Authorization=f"Bearer {TOKEN[:-1]}") == 401
        assert ask("/api/overview", Authorization=f"Basic {TOKEN}") == 401
        assert ask("/login?token=wrong") == 401
        welcome = browser(f"/login?token={TOKEN}", Host="10.0.0.3")
        assert (welcome.status, welcome.headers["location"]) == (303, "/")
        cookie = welcome.headers["set-cookie"]
        assert {"HttpOnly", "SameSite=strict"} <= {part.strip() for part in cookie.split(";")}
        assert ask("/api/overview", Cookie=cookie.split(";")[0]) == 200
        assert ask("/api/overview", Cookie="dcam=x") == 401
        form = browser("/", Host="pier-3", Accept="text/html")
        assert b'action="/login"' in form.body
        assert TOKEN.encode() not in form.body


def test_without_a_record_the_page_says_so(tmp_path: Path) -> None:
    with page(tmp_path) as browser:
        overview = browser("/api/overview").json
        assert overview["verdict"]["level"] == 3
        assert "no database: start dcamd once" in overview["items"][0]["text"]
        assert browser("/").status == 200
        answer = browser("/api/slot/2026-03-01")
        assert (answer.status, "no database" in answer.error) == (503, True)
        assert browser("/api/aim").status == 503


def test_a_record_of_a_newer_version_is_left_alone(tmp_path: Path) -> None:
    import sqlite3

    with open_store(tmp_path / "state") as store:
        store.add_measurement(record(slot(0)))
    with sqlite3.connect(tmp_path / "state" / "dcam.db") as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    connection.close()
    with page(tmp_path) as browser:
        answer = browser("/api/series")
        assert (answer.status, "newer version" in answer.error) == (503, True)
        assert "newer version" in browser("/api/overview").json["items"][0]["text"]


def test_an_answer_that_has_not_changed_is_not_sent_again(plain: Browser) -> None:
    first = plain("/api/calibrations", Accept_Encoding="gzip")
    again = plain("/api/calibrations", If_None_Match=first.headers["etag"])
    assert (again.status, again.body) == (304, b"")


def test_connections_that_ask_nothing_or_take_nothing_are_ended(
    plain: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "REQUEST_LIMIT_S", 0.2)
    monkeypatch.setattr(serving, "ANSWER_LIMIT_S", 0.2)
    monkeypatch.setattr(serving, "_LOOK_S", 0.05)
    silent = socket.create_connection(("127.0.0.1", plain.port), PATIENCE_S)
    halting = socket.create_connection(("127.0.0.1", plain.port), PATIENCE_S)
    halting.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")
    for slow in (silent, halting):
        with slow, contextlib.suppress(ConnectionResetError):
            assert slow.recv(1000) == b""
    assert json.loads(plain("/api/overview").body)["schema"] == 1
