"""Hundreds of faults of the cameras, in any order: slots go on, and nothing grows."""

import gc
import logging
import os
import tempfile
import threading
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from benchmarks.memory import resident_mb
from daemon.control.notify import Notifier
from daemon.slots.recovery import recover
from daemon.slots.reporting import Reporter
from daemon.slots.runner import SlotRunner
from daemon.slots.supervision import ProcessSpentError
from tests.daemon.conftest import Station
from tests.exhaustive import one_of
from tests.faults.cameras import ERRORS, GARBAGE
from tests.faults.faulty_source import FaultySource

FAULTS = 1000 // one_of(4)
SEED = 1
SETTLED = 200 // one_of(4)
"""Slots after which every cache has been filled."""
GROWTH_MB = 10.0


def handles() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.fixture
def station():
    """On a disk in memory, where there is one: hundreds of slots wait for many syncs."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        station = Station(Path(directory) / "state")
        with closing(station.store):
            yield station


@pytest.fixture
def source(station: Station):
    with closing(FaultySource(station.clock, SEED, FAULTS)) as source:
        yield source


def daemon(station: Station, source: FaultySource) -> SlotRunner:
    """What a process of dcamd does once it has started."""
    last_utc = recover(station.context, station.schedule)
    reporter = Reporter(Notifier(None))
    return SlotRunner(station.context, station.schedule, source, station.stop, last_utc, reporter)


def test_hundreds_of_faults(
    station: Station, source: FaultySource, caplog: pytest.LogCaptureFixture
) -> None:
    """Each slot with two sound cameras has its row, each other one a gap with a right cause."""
    for room in ("drivers", "daemon"):  # what is captured of the log would count as memory of ours
        caplog.set_level(logging.CRITICAL, f"dcam.{room}")
    threads: list[int] = []
    settled: list[tuple[float, int]] = []

    def look(number: int) -> None:
        threads.append(threading.active_count())
        if number == SETTLED:
            gc.collect()
            settled.append((resident_mb(os.getpid()), handles()))

    source.on_slot = look
    before = threading.active_count()
    runner = daemon(station, source)
    while source.begun < FAULTS or source.faulty:
        try:
            runner.run(1)
        except ProcessSpentError:  # so many slots lost to a camera that hangs
            source.restart()
            runner = daemon(station, source)
    runner.run(1)

    rows = station.store.measured_slots()
    causes = {
        gap.first_slot_utc + timedelta(minutes=number): gap.cause
        for gap in station.store.gaps()
        for number in range(gap.slots)
    }
    assert len(source.expected) == len(rows) + len(causes)
    wrong = [
        (f"{slot:%H:%M}", causes.get(slot), source.shown[slot])
        for slot, expected in source.expected.items()
        if (causes.get(slot) not in expected if expected else slot not in rows)
    ]
    assert wrong == []
    assert [camera.misused for camera in source.cameras] == [[], []]
    # What was meant to happen did: every kind, at both cameras, and enough of all.
    every = {*ERRORS, *GARBAGE, "hang", "hang for ever", "stale", "hang on close"}
    assert all(every <= trouble.kinds for trouble in source.troubles)
    assert sum(camera.hang.count for camera in source.cameras) > FAULTS / 10
    assert len(rows) > FAULTS / 10
    assert max(rows) == max(source.expected)
    # A thread for each camera, and one more for each that hangs; none is left.
    assert max(threads) <= before + 4
    gc.collect()
    resident, held = settled[0]
    assert handles() <= held + 2
    assert resident_mb(os.getpid()) < resident + GROWTH_MB
    source.close()
    assert threading.active_count() <= before
