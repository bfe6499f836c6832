"""A small record by hand, and its page as a browser asks for it."""

from __future__ import annotations

import http.client
import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.results import Displacement, Flag, Measurement, Reason
from daemon.config.reading import find_installation
from daemon.store.database import open_store
from daemon.store.records import CameraState, GapCause, MeasurementRecord, Reading
from daemon.web.app import build_app
from daemon.web.serving import serving
from daemon.web.settings import settings_of
from tests.daemon.commands.conftest import SIMULATED
from tests.daemon.store.examples import PERIOD_S, START, slot
from tests.shared import shared_directory
from tests.waiting import PATIENCE_S

ROWS = 600
PEAK, PEAK_MM = 137, 40.0
"""One row."""
DARK = range(300, 340)
UNTIL = slot(ROWS)


def y_mm(number: int) -> float:
    return PEAK_MM if number == PEAK else 2.0 * math.sin(number / 50.0)


def row(number: int, slot_utc: datetime | None = None) -> MeasurementRecord:
    """A row of the record: a wave with one peak, and an hour too dark."""
    dark = number in DARK
    value = Displacement(np.array([0.5, y_mm(number)]), np.diag([0.01, 0.04]))
    measurement = Measurement(
        flag=Flag.BAD if dark else Flag.GOOD,
        reasons=(Reason.TOO_DARK,) if dark else (),
        corrected=None if dark else value,
        raw=None if dark else value,
        motion=None,
    )
    return MeasurementRecord(
        slot_utc or slot(number),
        measurement,
        config_hash="c0ffee",
        version="0.1.0",
        main_camera=CameraState(temperature_c=20.0 + number / 100.0),
        readings=(Reading("air", "degC", number / 10.0),),
    )


def fill(directory: Path) -> None:
    """Write the record, with a gap at its end."""
    with open_store(directory / "state") as store:
        for number in range(ROWS):
            store.add_measurement(row(number))
        store.record_gap(slot(ROWS), slot(ROWS + 9), GapCause.POWER_LOSS, period_s=PERIOD_S)


def copy_record(factory: pytest.TempPathFactory, directory: Path) -> None:
    """The record as `directory/state`; it is written once for all tests."""
    shutil.copytree(shared_directory(factory, "waves", fill) / "state", directory / "state")


@dataclass(frozen=True, slots=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def error(self) -> str:
        return str(self.json["error"])


@dataclass(frozen=True, slots=True)
class Browser:
    """Asks the page; each time by a new connection."""

    port: int

    @property
    def url(self) -> str:
        return f"http://localhost:{self.port}"

    def __call__(self, path: str, method: str = "GET", **headers: str) -> Answer:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in {"Host": f"localhost:{self.port}", **headers}.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders()
            answer = connection.getresponse()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(answer.status, found, answer.read())
        finally:
            connection.close()

    def series(self, since: datetime, until: datetime, buckets: int, names: str) -> Any:
        ends = f"since={since.timestamp()}&until={until.timestamp()}"
        answer = self(f"/api/series?quantities={names}&{ends}&buckets={buckets}")
        assert answer.status == 200, answer.body
        return answer.json


@contextmanager
def page(tmp_path: Path, extra: str = "", **changes: object) -> Iterator[Browser]:
    """The page of `tmp_path/state`, with more in its config."""
    config = tmp_path / "dcam.toml"
    config.write_text(SIMULATED + extra, encoding="utf-8")
    settings = replace(
        settings_of(find_installation(config, tmp_path / "state")),
        cache=tmp_path / "cache",
        **changes,
    )
    with serving(build_app(settings), "127.0.0.1", 0, "") as port:
        yield Browser(port)


SINCE = START - timedelta(hours=1)
