"""One dcamd: a database and a clock for its whole life, and a station for each config it reads."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import structlog

from daemon.burst import take_burst
from daemon.clock.machine import simulated_machine, this_machine
from daemon.config.reading import Installation, load_config
from daemon.control.camera_lease import CameraLease
from daemon.control.control_socket import CommandHandlers, control_socket
from daemon.control.requests import ControlRequests
from daemon.devices import open_clock, open_pair_source, require_backend
from daemon.errors import ConfigError, StoreError, WorkFailedError
from daemon.log import configure_log
from daemon.readings.changes import Changes
from daemon.readings.sampler import open_sampler
from daemon.retention.guard import DiskGuard
from daemon.schedule import Schedule
from daemon.slots.exposure import last_known, loop_of
from daemon.slots.identity import made_by, made_with
from daemon.slots.measuring import active_calibration
from daemon.slots.pipeline import SlotContext
from daemon.slots.recovery import close_gap, mark_stop, recover
from daemon.slots.reporting import Reporter
from daemon.slots.runner import SlotRunner
from daemon.slots.snapshot import look_fields, measure_look, room_for_look
from daemon.slots.supervision import PROCESS_SPENT, Circuit, ProcessSpentError
from daemon.store.database import Store
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import GapCause
from drivers.errors import DriverError
from drivers.protocols import FramePairSource

_log = structlog.get_logger("dcam.daemon")

DAY = timedelta(days=1)
LOOK_PATIENCE_S = 100.0
"""How long a look waits for such a time; less than its client waits for the answer."""
STEPS_AT_START = 100
"""Of removing frames from a full disk, before the first row."""
RELOADED = "the config was read again"


@dataclass(frozen=True, slots=True)
class Station:
    """All that a config makes; a reload replaces it as a whole."""

    installation: Installation
    context: SlotContext
    schedule: Schedule
    source: FramePairSource


class Service:
    """Runs slots on a station until asked to stop, or to go on with another."""

    def __init__(
        self,
        installation: Installation,
        store: Store,
        requests: ControlRequests[Station],
        reporter: Reporter,
    ) -> None:
        self._store = store
        self._requests = requests
        self._reporter = reporter
        self._lease = CameraLease(changed=reporter.paused)
        accounted = store.accounted()
        self._clock = open_clock(installation.config, accounted[1] if accounted else None)
        self._station = self._build(installation)

    def run(self, max_slots: int | None, begin_to_close: Callable[[], None]) -> None:
        """Recover, run, close. Raises StoreError, ProcessSpentError."""
        store, clock, state = self._store, self._clock, self._station.installation.state_directory
        done = 0
        with ExitStack() as opened:
            opened.callback(self._close_devices)
            self._reporter.recovering()
            self._station.context.disk.make_room(STEPS_AT_START)
            last_utc = recover(self._station.context, self._station.schedule)
            store.add_event(clock.now_utc(), "started", f"version {made_by()}: {made_with()}")
            name = self._station.installation.config.name
            _log.info("started", site=name, version=made_by(), state=str(state))
            handlers = CommandHandlers(capture=self._look, reload=self._requests.reload)
            opened.enter_context(control_socket(state, self._lease, handlers))
            opened.callback(begin_to_close)
            self._requests.accept_reloads(self._reread)
            following: Station | None = self._station
            while following is not None:
                if following is not self._station:
                    last_utc = self._take_over(following)
                left = None if max_slots is None else max_slots - done
                done += self._run_station(last_utc, left)
                following = None if done == max_slots else self._requests.take()
            self._reporter.stopping()
        store.add_event(clock.now_utc(), "stopped", f"after {done} slots")
        mark_stop(store, clock.now_utc())
        _log.info("stopped", slots=done)

    def _close_devices(self) -> None:
        self._station.source.close()
        self._station.context.readings.close()

    def _build(self, installation: Installation) -> Station:
        """Make all of it; cameras are opened later. Raises ConfigError, DriverError."""
        config, archive = installation.config, FrameArchive(installation.state_directory)
        context = SlotContext(
            config.site(),
            config.config_hash(),
            self._store,
            archive,
            self._clock,
            DiskGuard(self._store, archive, config.retention.rules(), self._clock),
            config.burst_plan(),
            exposure=loop_of(config),
            readings=open_sampler(config),
            changes=Changes(self._store, self._clock),
            machine=simulated_machine(self._clock) if config.has_stepped_clock else this_machine(),
            late_row_done=self._reporter.late_row_done,
        )
        source = open_pair_source(config, self._clock)
        return Station(installation, context, config.schedule.schedule(), source)

    def _run_station(self, last_utc: datetime | None, max_slots: int | None) -> int:
        station = self._station
        context, schedule, source = station.context, station.schedule, station.source
        self._lease.use(source.close)
        burst_s = context.burst.limit_s if context.burst.count > 1 else 0.0
        self._reporter.running(schedule.period_s, burst_s)
        if context.exposure is not None:
            context.exposure.begin(source, last_known(self._store))
        prepare_cameras(source)
        if context.changes is not None:
            context.changes.begin()
        since = self._clock.now_utc() - DAY
        circuit = Circuit(ended_before=len(self._store.events(since, kind=PROCESS_SPENT)))
        runner = SlotRunner(
            *(context, schedule, source, self._requests.wake, last_utc, self._reporter),
            *(self._lease, circuit),
        )
        try:
            return runner.run(max_slots)
        except ProcessSpentError as error:
            self._note_spent(error)
            raise

    def _note_spent(self, error: ProcessSpentError) -> None:
        """Enter in the history that this process gives up: the next one has more patience."""
        _log.error("process_spent", error=str(error), exit_code=int(error.exit_code))
        try:
            self._store.add_event(self._clock.now_utc(), PROCESS_SPENT, str(error))
        except StoreError as refused:
            _log.error("event_not_recorded", error=str(refused))

    # ------------------------------------------------------------ asked for, in other threads

    def _reread(self) -> Station:
        """Make a station of the config file as it is now.

        Raises ConfigError, DriverError, WorkFailedError; the station that runs stays as it is.
        """
        now = self._station.installation
        if self._lease.reason is not None:
            msg = f"paused: {self._lease.reason}; try again later"
            raise WorkFailedError(msg)
        config = load_config(now.config.path)
        require_backend(config)
        for key, old, new in (
            ("storage.directory", now.config.storage.directory, config.storage.directory),
            ("simulation.clock", now.config.has_stepped_clock, config.has_stepped_clock),
        ):
            if old != new:
                msg = f"{config.path}: {key}: cannot be changed by a reload; restart dcamd"
                raise ConfigError(msg)
        return self._build(replace(now, config=config))

    def _take_over(self, station: Station) -> datetime | None:
        """Go on with another station; what its start costs in slots is a gap that says so."""
        config = station.installation.config
        with self._lease.slot(self._clock.now_utc()):  # a look ends first
            self._close_devices()
            self._station = station
        configure_log(config.log.format, config.log.level)
        self._store.add_event(self._clock.now_utc(), "reloaded", config.config_hash())
        _log.info("reloaded", site=config.name, config_hash=config.config_hash())
        return close_gap(station.context, station.schedule, GapCause.STOPPED, RELOADED)

    def _look(self) -> dict[str, Any]:
        """Take and measure a slot's pairs off the schedule. Raises DriverError, StoreError."""

        def has_room(ended_utc: datetime | None) -> bool:
            return room_for_look(self._station.schedule, self._clock.now_utc(), ended_utc)

        with self._lease.between_slots(has_room, LOOK_PATIENCE_S) as refusal:
            if refusal is not None:
                msg = f"{refusal}; try again later"
                raise WorkFailedError(msg)
            context, source = self._station.context, self._station.source
            slot_utc = self._clock.now_utc().replace(microsecond=0)
            shots = take_burst(source, self._clock, slot_utc, context.burst)
            readings = context.readings.between_slots(slot_utc)
        calibration = active_calibration(self._store)
        measurement = measure_look(
            shots, slot_utc, context.site, calibration, self._store, context.learner, readings
        )
        return look_fields(slot_utc, measurement, shots, context.site, readings)


def prepare_cameras(source: FramePairSource) -> None:
    """Open the cameras before the first slot is due; one that is not there costs slots only."""
    try:
        source.prepare()
    except DriverError as error:
        _log.warning("cameras_not_ready", error=str(error))
