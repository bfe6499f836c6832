"""A small site on a stepped clock, with a pair source that follows a script."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from core.site import (
    CameraGeometry,
    CheckerboardTarget,
    CirclesTarget,
    QualityLimits,
    RigPrior,
    Site,
)
from daemon.clock.machine import Machine
from daemon.control.notify import Notifier
from daemon.readings.sampler import Sampler
from daemon.retention.guard import DiskGuard
from daemon.retention.rules import Rules
from daemon.schedule import Schedule
from daemon.slots.pipeline import SlotContext
from daemon.slots.recovery import recover
from daemon.slots.reporting import Reporter
from daemon.slots.runner import SlotRunner
from daemon.slots.supervision import Circuit
from daemon.store.database import open_store
from daemon.store.frames.archive import FrameArchive
from drivers.clock import SteppedClock
from drivers.protocols import CapturedFrame, CapturedPair
from tests.daemon.times import minute_of
from tests.daemon.web.browsing import start_chromium

START = datetime(2026, 3, 1, 11, 59, 30, tzinfo=UTC)
SMALL = Rules(min_free_gb=0.0, reserve_mb=0)
"""Retention that a machine which is short of space does not bring into a test."""


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium: one for each process of the tests, whose thread can drive no second one."""
    with sync_playwright() as playwright:
        chromium = start_chromium(playwright)
        yield chromium
        chromium.close()


SIZE = (48, 64)
CAMERA = CameraGeometry(width_px=64, height_px=48, pixel_pitch_um=5.86, focal_length_mm=6.0)
SITE = Site(
    main=CAMERA,
    sub=CAMERA,
    main_target=CirclesTarget(np.eye(3, 2), np.ones(3), 1000.0, 1.0),
    sub_target=CheckerboardTarget(8, 7, 2.0, 50.0),
    rig=RigPrior(np.zeros(3), 1.0, np.zeros(3), 1.0),
    quality=QualityLimits(),
)


@dataclass
class ScriptedSource:
    """Gives a pair at each slot, unless its script has something else for that slot."""

    clock: SteppedClock
    orders: dict[int, Callable[[], object]] = field(default_factory=dict)
    """Number of the capture, from 0, to what happens at it before the pair is given."""
    captures: list[datetime] = field(default_factory=list)

    def prepare(self) -> None:
        pass

    def set_exposure(self, role: str, exposure_us: float, gain_db: float | None) -> None:
        pass

    def capture(self, slot_utc: datetime) -> CapturedPair:
        number = len(self.captures)
        self.captures.append(slot_utc)
        order = self.orders.get(number)
        if order is not None:
            order()
        return CapturedPair(self._frame(number), self._frame(number + 100), skew_s=0.001)

    def _frame(self, seed: int) -> CapturedFrame:
        pixels = np.random.default_rng(seed).integers(0, 255, SIZE, dtype=np.uint8)
        return CapturedFrame(pixels, 8, seed, 0, self.clock.monotonic_s(), exposure_us=5000.0)

    def close(self) -> None:
        pass


class Station:
    """A site as one process after another would run it: each `run` is a daemon's life."""

    def __init__(self, state: Path, period_s: int = 60, rules: Rules = SMALL) -> None:
        self.state = state
        self.rules = rules
        self.clock = SteppedClock(START)
        self.schedule = Schedule(period_s)
        self.store = open_store(state)
        self.archive = FrameArchive(state)
        self.booted_s: dict[str, float] = {}
        self.synchronised: bool | None = None
        self.readings = Sampler()
        self.context = self.pipeline("boot-1")
        self.source = ScriptedSource(self.clock)
        self.stop = threading.Event()

    def pipeline(self, boot_id: str) -> SlotContext:
        """What slots pass through in one run of the machine, which begins now if it is new."""
        booted_s = self.booted_s.setdefault(boot_id, self.clock.monotonic_s())
        machine = Machine(
            boot_id, lambda: self.clock.monotonic_s() - booted_s, lambda: self.synchronised
        )
        disk = DiskGuard(self.store, self.archive, self.rules, self.clock)
        return SlotContext(
            *(SITE, "hash", self.store, self.archive, self.clock, disk),
            readings=self.readings,
            machine=machine,
        )

    def start(self, boot_id: str = "boot-1", circuit: Circuit | None = None) -> SlotRunner:
        self.context = self.pipeline(boot_id)
        last = recover(self.context, self.schedule)
        return SlotRunner(
            self.context,
            self.schedule,
            self.source,
            self.stop,
            last,
            Reporter(Notifier(None)),
            circuit=circuit,
        )

    def run(self, slots: int, orders: dict | None = None, boot_id: str = "boot-1") -> None:
        runner = self.start(boot_id)
        self.source.captures.clear()
        self.source.orders = orders or {}
        assert runner.run(slots) == slots

    def minutes(self) -> list[int]:
        """Minutes after noon of the slots with a row."""
        return sorted(minute_of(slot) for slot in self.store.measured_slots())

    def gaps(self) -> list[tuple[int, int, str]]:
        """First and last minute, and cause."""
        return [
            (minute_of(gap.first_slot_utc), minute_of(gap.last_slot_utc), gap.cause.value)
            for gap in self.store.gaps()
        ]


@pytest.fixture
def station(tmp_path: Path):
    station = Station(tmp_path / "state")
    yield station
    station.store.close()


@pytest.fixture
def make_station(tmp_path: Path):
    """Several sites in one test, each with a state directory of its own."""
    made: list[Station] = []

    def make() -> Station:
        made.append(Station(tmp_path / f"state-{len(made)}"))
        return made[-1]

    yield make
    for station in made:
        station.store.close()
