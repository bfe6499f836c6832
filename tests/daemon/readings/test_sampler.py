"""Readings are asked for ahead and collected at once, whatever a sensor does meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest

from daemon.config.readings import ReadingSection
from daemon.readings.sampler import Probe, Sampler
from daemon.store.records import Reading
from drivers.errors import SensorError
from tests.waiting import PATIENCE_S, wait_for

SLOT = datetime(2026, 3, 1, tzinfo=UTC)
NEXT = SLOT + timedelta(minutes=1)


class Scripted:
    """A sensor that says what it is told to, when it is let."""

    def __init__(self, bus: str, answer: float | str | Exception = 21.5) -> None:
        self.bus = bus
        self.answer = answer
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.reads = 0

    def read(self, timeout_s: float) -> float:
        self.reads += 1
        assert self.may_answer.wait(PATIENCE_S)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def stop(self) -> None:
        self.may_answer.set()


def probe(sensor: Scripted, name: str = "air", **more: object) -> Probe:
    section = {"name": name, "unit": "degC", "file": "/x", "timeout_s": 5.0} | more
    return Probe(ReadingSection.model_validate(section), sensor)


@pytest.fixture
def sampler_of() -> Iterator[object]:
    made: list[Sampler] = []

    def make(*probes: Probe, patient: bool = False) -> Sampler:
        made.append(Sampler(probes, patient=patient))
        return made[-1]

    yield make
    for sampler in made:
        sampler.close()


def readings_threads() -> set[threading.Thread]:
    """Those of all samplers that have not ended."""
    return {thread for thread in threading.enumerate() if thread.name == "readings"}


def value_of(sampler: Sampler, slot: datetime, name: str = "air") -> float | None:
    return {one.name: one.value for one in sampler.collect(slot)}[name]


def test_each_reading_is_there_once_it_has_been_read(sampler_of) -> None:
    """In the order of the config, with its unit; each slot is read for once."""
    warm, wet = Scripted("a"), Scripted("b", 80.0)
    sampler = sampler_of(probe(warm), probe(wet, "moist", unit="percent"))
    sampler.ahead(SLOT, 0.0)
    sampler.ahead(SLOT, 0.0)
    wait_for(lambda: None not in {one.value for one in sampler.collect(SLOT)}, "both values")
    assert sampler.collect(SLOT) == (
        Reading("air", "degC", 21.5),
        Reading("moist", "percent", 80.0),
    )
    assert (warm.reads, wet.reads) == (1, 1)
    assert value_of(sampler, NEXT) is None


def test_nobody_waits_for_a_sensor_that_hangs(sampler_of) -> None:
    """It gets one thread and no other; once it answers it is read again."""
    stuck, well = Scripted("a"), Scripted("b")
    stuck.may_answer.clear()
    sampler = sampler_of(probe(stuck, timeout_s=60.0), probe(well, "deck"))
    before, begun_s = readings_threads(), time.monotonic()
    for number in range(5):
        slot = SLOT + number * timedelta(minutes=1)
        sampler.ahead(slot, 0.0)
        wait_for(lambda slot=slot: value_of(sampler, slot, "deck") == 21.5, "the other one")
        (air, _) = sampler.collect(slot)  # returns, though the sensor does not
        assert (air.value, bool(air.cause)) == (None, True)
    assert time.monotonic() - begun_s < 50.0  # five times a minute, had it been waited for
    assert (stuck.reads, well.reads) == (1, 5)
    assert len(readings_threads() - before) == 2
    stuck.may_answer.set()
    wait_for(lambda: value_of(sampler, slot) == 21.5, "its value for the newest slot")
    assert stuck.reads == 2


def test_what_hangs_says_for_how_long_and_what_waits_behind_it(sampler_of) -> None:
    stuck, behind = Scripted("line"), Scripted("line")
    stuck.may_answer.clear()
    sampler = sampler_of(probe(stuck, timeout_s=0.1), probe(behind, "deck", timeout_s=0.1))
    sampler.ahead(SLOT, 0.0)
    wait_for(lambda: "no answer for" in sampler.collect(SLOT)[0].cause, "its time to be over")
    assert "behind air, which has not answered" in sampler.collect(SLOT)[1].cause
    assert behind.reads == 0


def test_a_reading_is_asked_for_only_shortly_before_its_slot(sampler_of) -> None:
    early = Scripted("a")
    sampler = sampler_of(probe(early))
    sampler.ahead(SLOT, 1000.0)
    assert sampler.collect(SLOT) == (Reading("air", "degC", None, "not read in time"),)
    sampler.ahead(SLOT, 4.0)  # the clock was stepped
    wait_for(lambda: value_of(sampler, SLOT) == 21.5, "the value")
    assert early.reads == 1


@pytest.mark.parametrize(
    ("answer", "more", "expected"),
    [
        (21562.0, {"scale": 0.001}, (21.562, "")),
        (250.0, {"scale": 0.1, "offset": -5.0}, (20.0, "")),
        (85.0, {"max": 60.0}, (None, "outside limits (85 degC)")),
        (-41.0, {"min": -40.0}, (None, "outside limits (-41 degC)")),
        (60.0, {"min": 60.0}, (60.0, "")),
        (SensorError("no\nchip"), {}, (None, "no chip")),
        (ZeroDivisionError("by zero"), {}, (None, "ZeroDivisionError: by zero")),
    ],
)
def test_a_number_becomes_a_value_or_a_cause(sampler_of, answer, more, expected) -> None:
    """A simulated site waits for its readings: there is nothing to be late for."""
    sampler = sampler_of(probe(Scripted("a", answer), **more), patient=True)
    sampler.ahead(SLOT, 1000.0)
    (reading,) = sampler.collect(SLOT)
    assert (reading.value, reading.cause) == expected


def test_a_site_without_sensors_has_no_thread() -> None:
    before = readings_threads()
    sampler = Sampler()
    sampler.ahead(SLOT, 0.0)
    assert sampler.collect(SLOT) == ()
    assert readings_threads() <= before


def test_a_look_between_slots_reads_now_and_leaves_the_next_slot_asked_for(sampler_of) -> None:
    warm = Scripted("a")
    sampler = sampler_of(probe(warm))
    sampler.ahead(NEXT, 5.2)
    between = SLOT + timedelta(seconds=20)
    assert sampler.between_slots(between) == (Reading("air", "degC", 21.5),)
    warm.answer = 22.0
    wait_for(lambda: value_of(sampler, NEXT) is not None, "the next slot's value")
    assert value_of(sampler, NEXT) == 22.0
