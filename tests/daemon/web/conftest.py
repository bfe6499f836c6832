"""dcam-web beside a record of two weeks; each process of the tests runs its own."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from benchmarks.page_record import FIRST, MINUTE, PageRecord, write_record
from benchmarks.page_server import ROOT, serving, wait_until_read
from daemon.config.reading import load_config
from daemon.store.database import open_store
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.times import slot_text
from tests.daemon.web.browsing import WIDE, Visit, visiting
from tests.shared import shared_directory

SLOTS = 20_000
"""More than a figure has pixels, so that buckets are drawn."""
SITE = (ROOT / "benchmarks/small.toml").read_text(encoding="utf-8")
CONFIG = SITE.replace('name = "small"', 'name = "small"\ntimezone = "Europe/Zurich"')


LEVELLING = """time,y_mm,sigma_mm
2026-03-03T00:00:00Z,0.0,0.01
2026-03-07T06:00:00Z,1.0,0.01
2026-03-11T12:00:00Z,0.0,0.01
"""
"""Within what the record reaches, and not what it was then."""


@dataclass(frozen=True, slots=True)
class Served:
    """Where the page is, and what its record has."""

    url: str
    record: PageRecord


def whole(served: Served) -> tuple[str, str]:
    return slot_text(FIRST), slot_text(served.record.last + MINUTE)


def make_site(directory: Path) -> None:
    """A site with its record, which dcam-web has read once."""
    config, state = directory / "dcam.toml", directory / "state"
    config.write_text(f'{CONFIG}\n[report]\nreference = "levelling.csv"\n')
    (directory / "levelling.csv").write_text(LEVELLING)
    record = write_record(state, load_config(config).site(), SLOTS)
    span = record.suspect, record.suspect + timedelta(minutes=30)
    painted = LedgerEntry(LedgerKind.EXCLUDE, "Eve", record.last, "plate painted", *span)
    with open_store(state) as store:
        store.add_ledger_entry(painted)
    with serving(config, state) as url:
        wait_until_read(url)
    (directory / "record.pickle").write_bytes(pickle.dumps(record))


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    directory = shared_directory(tmp_path_factory, "page", make_site)
    record: PageRecord = pickle.loads((directory / "record.pickle").read_bytes())
    with serving(directory / "dcam.toml", directory / "state") as url:
        wait_until_read(url)
        yield Served(url, record)


@pytest.fixture
def visit(browser: Browser, served: Served) -> Iterator[Visit]:
    with visiting(browser, served.url, **WIDE) as visit:
        yield visit
        assert visit.complaints == []
