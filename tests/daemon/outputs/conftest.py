"""A record that grows, and a sender that runs beside it in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import pytest

from daemon.outputs.backoff import Backoff
from daemon.outputs.output import Output
from daemon.outputs.sender import Sender
from daemon.store.database import open_store
from tests.daemon.store.examples import full_measurement, full_record, record, slot
from tests.waiting import PATIENCE_S


class Record:
    """A state directory with rows."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.slots: list[str] = []
        self._minute = 0

    def add(self, rows: int = 1, *, at: datetime | None = None, full: bool = False) -> None:
        """Write rows of the next minutes, or one of a given slot, however late."""
        with open_store(self.state) as store:
            for _ in range(rows):
                when = at if at is not None else slot(self._minute)
                self._minute += at is None
                made = full_record(when) if full else record(when, full_measurement())
                store.add_measurement(made)
                self.slots.append(text_of(when))


def text_of(when: datetime) -> str:
    return f"{when:%Y-%m-%dT%H:%M:%SZ}"


@pytest.fixture
def kept(tmp_path: Path) -> Record:
    """An empty record."""
    (tmp_path / "state").mkdir()
    return Record(tmp_path / "state")


Follow = Callable[[Record, Output], Sender]


@pytest.fixture
def follow() -> Iterator[Follow]:
    """Start a sender that follows a record; ended after the test."""
    running: list[tuple[Sender, threading.Thread]] = []

    def start(record: Record, output: Output) -> Sender:
        sender = Sender(record.state, output, look_every_s=0.01, backoff=Backoff(0.01, 0.1))
        thread = threading.Thread(target=sender.follow)
        thread.start()
        running.append((sender, thread))
        return sender

    yield start
    for sender, _ in running:
        sender.stop.set()
    for _, thread in running:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
