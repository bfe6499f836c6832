"""A small site run by the product's own parts, without cameras; what it said is written down.

A pair shows its slot in its pixels, and what is measured is read from them: a row made late must
be that of its own frames.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import structlog

from core.results import Displacement, Flag, Measurement
from daemon.retention.rules import Rules
from daemon.slots import pipeline, row_history
from daemon.slots.measuring import ImagePair
from daemon.slots.runner import SlotRunner
from daemon.store.database import Store
from daemon.store.opening import open_checked_store
from drivers.clock import SteppedClock
from drivers.protocols import CapturedFrame, CapturedPair
from tests.daemon.conftest import SMALL, Station

PERIOD_S = 60
SIZE = (48, 64)


class SlotSource:
    """Gives each slot its own pair; an order for a slot is carried out before."""

    def __init__(
        self, clock: SteppedClock, orders: Mapping[datetime, Callable[[], object]]
    ) -> None:
        self._clock = clock
        self._orders = orders

    def prepare(self) -> None:
        pass

    def close(self) -> None:
        pass

    def set_exposure(self, role: str, exposure_us: float, gain_db: float | None) -> None:
        pass

    def capture(self, slot_utc: datetime) -> CapturedPair:
        self._orders.get(slot_utc, lambda: None)()
        main, sub = (self._frame(slot_utc, role) for role in range(2))
        return CapturedPair(main, sub, skew_s=0.001)

    def _frame(self, slot_utc: datetime, role: int) -> CapturedFrame:
        seed = (int(slot_utc.timestamp()), role)
        pixels = np.random.default_rng(seed).integers(0, 255, SIZE, dtype=np.uint8)
        return CapturedFrame(pixels, 8, 1, 0, self._clock.monotonic_s(), exposure_us=5000.0)


@contextmanager
def daemon(
    state: Path,
    now_utc: datetime,
    boot_id: str,
    orders: Mapping[datetime, Callable[[], object]] | None = None,
    rules: Rules = SMALL,
) -> Iterator[tuple[Station, SlotRunner]]:
    """Open, check and recover as dcamd does, ready for the first slot."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules[Station.__module__], "open_store", open_checked_store)
        station = Station(state, PERIOD_S, rules)
    with closing(station.store):
        station.clock = SteppedClock(now_utc)
        station.source = SlotSource(station.clock, orders or {})
        runner = station.start(boot_id)
        station.store.add_event(station.clock.now_utc(), "started", boot_id)
        yield station, runner


@contextmanager
def heard(acknowledged: Callable[[datetime], object]) -> Iterator[None]:
    """Measure by eye; hear each slot that the log acknowledges, at once."""

    def listen(_logger: Any, _method: str, event: structlog.typing.EventDict) -> str:
        if event["event"] == "slot_done":
            acknowledged(datetime.fromisoformat(event["slot"]))
        raise structlog.DropEvent

    before = structlog.get_config()
    with measured_by_eye():
        structlog.configure(processors=[listen], logger_factory=structlog.ReturnLoggerFactory())
        try:
            yield
        finally:
            structlog.configure(**before)


@contextmanager
def measured_by_eye() -> Iterator[None]:
    """Measure without looking for targets, which these small images do not show."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(row_history, "measure", measure_by_eye)
        patch.setattr(pipeline, "active_calibration", calibration_by_number)
        patch.setattr(row_history, "judge_in_history", lambda *arguments: arguments[-1])
        yield


def calibration_by_number(store: Store) -> SimpleNamespace | None:
    """The active calibration as a row names it."""
    record = store.active_calibration()
    calibration = SimpleNamespace(calibrated=SimpleNamespace(further=()))
    datum = None if record is None else store.datum(record.id)
    return record and SimpleNamespace(id=record.id, datum=datum, calibration=calibration)


def measure_by_eye(pairs: Sequence[ImagePair], *_: object) -> Measurement:
    """A measurement that tells which images it was made from."""
    (pair,) = pairs
    assert pair.main is not None
    assert pair.sub is not None
    seen = Displacement(
        np.array([pair.main.pixels.mean(), pair.sub.pixels.mean()]), np.diag([0.01, 0.02])
    )
    return Measurement(Flag.GOOD, (), corrected=seen, raw=seen, motion=None)
