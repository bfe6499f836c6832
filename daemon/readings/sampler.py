"""Reads all sensors ahead of each slot, each bus in a thread of its own, and waits for none.

A sensor that hangs keeps its own thread and nothing else: no slot waits for it, and no second
thread or process is started beside one that has not ended.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from daemon.config.model import Config
from daemon.config.readings import PERIOD_SHARE, ReadingSection
from daemon.devices import open_sensor
from daemon.readings.value import read_now, without_value
from daemon.store.records import Reading
from daemon.text import span_text
from drivers.protocols import Sensor

CLOSE_S = 1.0
"""How long closing waits for threads; those that hang are left behind."""

SAME_S = 1.0
"""A slot asked for twice is read twice only if the clock was stepped by more than this."""


@dataclass(frozen=True, slots=True)
class Probe:
    """A reading as configured, and its sensor."""

    section: ReadingSection
    sensor: Sensor


class Sampler:
    """Readings for slots: asked for ahead, collected when the pair has been taken."""

    def __init__(
        self, probes: Sequence[Probe] = (), period_s: float = 60.0, *, patient: bool = False
    ) -> None:
        """`patient` waits for readings: where time is simulated, no slot is late for it."""
        buses: dict[str, list[Probe]] = {}
        for probe in probes:
            buses.setdefault(probe.sensor.bus, []).append(probe)
        room_s = PERIOD_SHARE * period_s
        self._buses = [_Bus(members, room_s) for members in buses.values()]
        self._sections = [probe.section for probe in probes]
        self._patient = patient

    def ahead(self, slot_utc: datetime, in_s: float) -> None:
        """Ask for a slot's readings, which is due in so many seconds; gives at once."""
        for bus in self._buses:
            bus.ask(slot_utc, 0.0 if self._patient else in_s)

    def collect(self, slot_utc: datetime) -> tuple[Reading, ...]:
        """What there is for a slot, in the order of the config; what is not there says why."""
        found: dict[str, Reading] = {}
        for bus in self._buses:
            if self._patient:
                bus.wait(slot_utc)
            found |= bus.collect(slot_utc)
        return tuple(found[section.name] for section in self._sections)

    def between_slots(self, now_utc: datetime) -> tuple[Reading, ...]:
        """Read all sensors now and wait for them; what was asked for ahead stays asked for."""
        found: dict[str, Reading] = {}
        for bus in self._buses:
            found |= bus.read_between(now_utc)
        return tuple(found[section.name] for section in self._sections)

    def of_stored(self, values: Mapping[str, float]) -> tuple[Reading, ...]:
        """A slot's readings as they stand beside its frames, which do not say why one is not."""
        return tuple(
            Reading(section.name, section.unit, values[section.name])
            if section.name in values
            else without_value(section, "not known: the row was made from its frames")
            for section in self._sections
        )

    def close(self) -> None:
        """Kill programs that run, and let the threads end."""
        for bus in self._buses:
            bus.stop()
        ends_s = time.monotonic() + CLOSE_S
        for bus in self._buses:
            bus.join(max(ends_s - time.monotonic(), 0.0))


def open_sampler(config: Config, *, patient: bool = False) -> Sampler:
    """Give the site's sampler; nothing is read before it is asked."""
    probes = [
        Probe(section, open_sensor(config, number)) for number, section in enumerate(config.reading)
    ]
    return Sampler(probes, config.schedule.period_s, patient=patient or config.has_stepped_clock)


@dataclass(slots=True)
class _Request:
    """A slot's readings on one bus."""

    slot_utc: datetime
    begin_s: float
    """Monotonic time at which to begin."""
    found: dict[str, Reading] = field(default_factory=dict)
    done: bool = False


class _Bus:
    """The sensors of one bus, and the thread that reads one after the other."""

    def __init__(self, probes: Sequence[Probe], room_s: float) -> None:
        self._probes = probes
        self._lead_s = min(sum(probe.section.timeout_s for probe in probes), room_s)
        self._changed = threading.Condition()
        self._request: _Request | None = None
        self._reading: tuple[ReadingSection, float] | None = None
        """What is being read, and since when (monotonic)."""
        self._stopped = False
        self._thread: threading.Thread | None = None

    def ask(self, slot_utc: datetime, in_s: float) -> None:
        with self._changed:
            begin_s = time.monotonic() + in_s - self._lead_s
            known = self._request
            if known and known.slot_utc == slot_utc and abs(known.begin_s - begin_s) < SAME_S:
                return
            self._request = _Request(slot_utc, begin_s)
            if self._thread is None and not self._stopped:
                # A daemon, so that a sensor that hangs cannot keep the process from ending.
                self._thread = threading.Thread(target=self._run, name="readings", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def wait(self, slot_utc: datetime) -> None:
        """Wait for a slot's readings, but not for a sensor that is past its time."""

        def is_over() -> bool:
            request = self._request
            return request is None or request.slot_utc != slot_utc or request.done

        with self._changed:
            ends_s = time.monotonic() + sum(probe.section.timeout_s for probe in self._probes)
            while not is_over() and not self._hangs() and time.monotonic() < ends_s:
                self._changed.wait(0.05)

    def collect(self, slot_utc: datetime) -> dict[str, Reading]:
        with self._changed:
            request = self._request
            mine = request.found if request and request.slot_utc == slot_utc else {}
            return {
                probe.section.name: mine.get(probe.section.name) or self._why_not(probe.section)
                for probe in self._probes
            }

    def read_between(self, now_utc: datetime) -> dict[str, Reading]:
        with self._changed:
            next_one = self._request
        self.ask(now_utc, 0.0)
        self.wait(now_utc)
        found = self.collect(now_utc)
        with self._changed:
            if next_one is not None and self._request and self._request.slot_utc == now_utc:
                self._request = next_one
                self._changed.notify_all()
        return found

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        for probe in self._probes:
            probe.sensor.stop()

    def join(self, timeout_s: float) -> None:
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _hangs(self) -> bool:
        if self._reading is None:
            return False
        section, since_s = self._reading
        return time.monotonic() - since_s > section.timeout_s

    def _why_not(self, section: ReadingSection) -> Reading:
        """Say why there is no value yet; the lock is held."""
        if self._reading is None or not self._hangs():
            return without_value(section, "not read in time")
        hanging, since_s = self._reading
        span = span_text(time.monotonic() - since_s)
        if hanging is section:
            return without_value(section, f"no answer for {span}")
        return without_value(section, f"behind {hanging.name}, which has not answered for {span}")

    def _run(self) -> None:
        while (request := self._next()) is not None:
            for probe in self._probes:
                if not self._read(request, probe):
                    break
            with self._changed:
                request.done = True
                self._changed.notify_all()

    def _next(self) -> _Request | None:
        """Wait until a request is due; None at the end."""
        with self._changed:
            while not self._stopped:
                request = self._request
                if request is None or request.done:
                    self._changed.wait()
                elif (left_s := request.begin_s - time.monotonic()) > 0:
                    self._changed.wait(left_s)
                else:
                    return request
            return None

    def _read(self, request: _Request, probe: Probe) -> bool:
        """Read one sensor for a request; False when that is no longer wanted."""
        with self._changed:
            if self._stopped or request is not self._request:
                return False
            begun_s = time.monotonic()
            self._reading = probe.section, begun_s
        reading = read_now(probe.section, probe.sensor)
        with self._changed:
            self._reading = None
            request.found[probe.section.name] = reading
            return True
