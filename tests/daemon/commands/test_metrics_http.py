"""`/metrics` of the page says what `dcam-ctl metrics` says; Grafana asks for nothing else."""

from __future__ import annotations

import asyncio
import json
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families
from starlette.types import Message

from daemon.config.reading import Installation, load_config
from daemon.web.app import build_app
from daemon.web.settings import Settings
from tests.daemon.commands.conftest import GOOD, CameraState, Ctl, Site

DASHBOARD = Path(__file__).parents[3] / "deploy/grafana/dcam.json"


def asked(site: Site, cache: Path, host: str = "localhost:8080") -> tuple[int, dict[str, str], str]:
    """Status, headers and text of `/metrics`."""
    found = Installation(site.config, load_config(site.config), site.state)
    app = build_app(Settings(found, cache))
    messages: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Message) -> None:
        messages.append(message)

    scope = {
        "type": "http",
        "method": "GET",
        "path": "/metrics",
        "raw_path": b"/metrics",
        "query_string": b"",
        "root_path": "",
        "scheme": "http",
        "http_version": "1.1",
        "headers": [(b"host", host.encode())],
        "server": None,
        "client": None,
    }
    with ThreadPoolExecutor(1) as other:  # a browser of other tests has its loop in this thread
        other.submit(asyncio.run, app(scope, receive, send)).result()
    start, *parts = messages
    headers = {name.decode(): text.decode() for name, text in start["headers"]}
    return start["status"], headers, b"".join(part["body"] for part in parts).decode()


def families(text: str) -> dict[str, set[str]]:
    """The labels of each metric by its name."""
    return {
        family.name: {label for sample in family.samples for label in sample.labels}
        for family in text_string_to_metric_families(text)
    }


def full(tmp_path: Path, ctl: Ctl) -> Site:
    """A site of which everything is known."""
    site = Site(tmp_path, ctl)
    site.calibrate()
    warm = CameraState(5000.0, 0.0, 21.0)
    site.measure(3, GOOD, main_camera=warm, sub_camera=warm)
    return site


def test_prometheus_reads_over_http_what_the_command_writes(tmp_path: Path, ctl: Ctl) -> None:
    site = full(tmp_path, ctl)
    status, headers, text = asked(site, tmp_path / "cache")
    assert status == 200
    assert headers["content-type"].startswith("text/plain; version=0.0.4")
    assert families(text) == families(site.ctl("metrics").out)
    assert asked(site, tmp_path / "cache", "evil.example")[0] == 403


def test_without_a_database_the_level_says_so(tmp_path: Path, ctl: Ctl) -> None:
    status, _, text = asked(Site(tmp_path, ctl), tmp_path / "cache")
    assert status == 200
    assert "dcam_level 3.0" in text


def test_each_metric_and_label_of_the_grafana_file_exists(tmp_path: Path, ctl: Ctl) -> None:
    known = families(full(tmp_path, ctl).ctl("metrics").out)
    dashboard = json.loads(DASHBOARD.read_text())
    questions = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    questions += [one["query"]["query"] for one in dashboard["templating"]["list"][1:]]
    assert len(questions) > 10
    for question in questions:
        names = re.findall(r"dcam_\w+", question)
        assert names, question
        for name in names:
            assert name in known, question
        for name, labels in re.findall(r"(dcam_\w+)\{([^}]*)\}", question):
            used = set(re.findall(r"(\w+)=", labels)) - {"instance"}  # Prometheus' own
            assert used <= known[name], question
    titles = [panel["title"] for panel in dashboard["panels"]]
    assert len(set(titles)) == len(titles)
