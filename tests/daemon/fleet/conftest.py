"""One PostgreSQL server for all tests of the session, a new database for each."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import psycopg
import pytest

from daemon.fleet.sync import Copied, Sync
from daemon.outputs.backoff import Backoff
from daemon.store.central.connecting import CentralAwayError, connect_central, prepare
from daemon.store.central.writing import SiteFacts
from daemon.store.database import open_store
from daemon.store.records import MeasurementRecord
from tests.daemon.fleet.postgres import Server
from tests.daemon.store.examples import START, full_record, slot

_numbers = itertools.count()


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A running server."""
    started = Server("shared_buffers=16MB", "autovacuum=off")
    try:
        yield started
    finally:
        started.remove()


@pytest.fixture
def empty(server: Server) -> str:
    """The name of a new database without tables."""
    name = f"fleet_{next(_numbers)}"
    with closing(psycopg.connect(server.url("postgres"), autocommit=True)) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return name


@pytest.fixture
def central(server: Server, empty: str) -> str:
    """The name of a new central database."""
    made = connect_central(server.url(empty), None)
    prepare(made)
    made.close()
    return empty


Pier = Callable[..., Path]


@pytest.fixture
def pier(tmp_path: Path) -> Pier:
    """Make a state directory with a calibration and rows of consecutive minutes."""

    def make(name: str, rows: int, start: datetime = START) -> Path:
        state = tmp_path / name
        state.mkdir()
        add_rows(state, range(rows), start)
        return state

    return make


def add_rows(state: Path, minutes: range, start: datetime = START) -> None:
    """Write full rows of minutes after a start."""
    with open_store(state) as store:
        for minute in minutes:
            store.add_measurement(row_at(slot(minute, start)))


def row_at(slot_utc: datetime, calibration_id: int | None = None) -> MeasurementRecord:
    """A row with everything, under the slot at which it was taken."""
    return replace(full_record(slot_utc, calibration_id), redated_from_utc=None)


def sync(url: str, state: Path, name: str = "pier-1", batch: int = 50, tries: int = 50) -> Copied:
    """Copy once, patiently."""
    run = Sync(
        url,
        None,
        state,
        SiteFacts(name, 60, (50.0, 8.0)),
        batch=batch,
        backoff=Backoff(0.01, 0.1),
    )
    for _ in range(tries):
        with suppress(CentralAwayError):
            return run.run()
    raise AssertionError
