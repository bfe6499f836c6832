"""`dcamd`, the daemon: opens everything, runs slots until told to stop, closes everything."""

from __future__ import annotations

import faulthandler
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from datetime import datetime, timedelta
from types import FrameType

import click
import structlog

from daemon.commands.options import Options, common_options, pass_options
from daemon.config import Installation
from daemon.control import control_socket
from daemon.devices import open_clock, open_pair_source, require_backend
from daemon.errors import run
from daemon.exposure import last_known, loop_of
from daemon.health import has_stepped_clock
from daemon.lock import sole_writer
from daemon.log import configure_log
from daemon.machine import simulated_machine, this_machine
from daemon.notify import Notifier
from daemon.pause import Pause
from daemon.pipeline import Pipeline
from daemon.recovery import mark_stop, recover
from daemon.reporting import Reporter
from daemon.run_state import runtime_directory
from daemon.runner import SlotRunner
from daemon.store.database import Store, database_bytes
from daemon.store.errors import StoreError
from daemon.store.frames import FrameArchive
from daemon.store.opening import damage_noted, open_checked_store
from daemon.supervision import PROCESS_SPENT, Circuit, ProcessSpentError
from daemon.version import VERSION
from drivers.errors import DriverError
from drivers.protocols import FramePairSource

_log = structlog.get_logger("dcam.daemon")

DAY = timedelta(days=1)
CLOSE_LIMIT_S = 30.0
"""To close cameras and database, which have deadlines of their own."""
EXIT_LIMIT_S = 10.0
"""For libraries to end what they have begun, once everything of ours is closed."""
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)


@click.command(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="\b\nExample:\n  dcamd --config dcam.toml --state /tmp/dcam --max-slots 10",
)
@click.option(
    "--max-slots",
    type=click.IntRange(min=1),
    metavar="N",
    help="End cleanly after N slots; without it run until SIGTERM.",
)
@click.version_option(VERSION, prog_name="dcamd")
@common_options
@pass_options
def cli(options: Options, max_slots: int | None) -> None:
    """Take, measure and record one frame pair a slot, until SIGTERM or Ctrl-C.

    Each slot of the schedule ends as a row or in a gap with its cause. Logs go to stderr.
    """
    serve(options.installation, max_slots)


def serve(installation: Installation, max_slots: int | None = None) -> None:
    """Run the daemon on a site until told to stop.

    Raises ConfigError, AlreadyRunningError, StoreError, DriverError.
    """
    config = installation.config
    require_backend(config)
    configure_log(config.log.format, config.log.level)
    state = installation.state_directory
    with stop_on_signals() as stop, sole_writer(state):
        reporter = Reporter(Notifier.from_environment(), runtime_directory(state))
        reporter.opening(database_bytes(state))
        with (
            time_limit_to_close() as begin_to_close,
            closing(open_checked_store(state, tell=reporter.salvaging)) as store,
            damage_noted(store),
        ):
            try:
                _run(installation, store, stop, reporter, begin_to_close, max_slots)
            finally:
                reporter.stopping()


def _run(
    installation: Installation,
    store: Store,
    stop: threading.Event,
    reporter: Reporter,
    begin_to_close: Callable[[], None],
    max_slots: int | None,
) -> None:
    config = installation.config
    accounted = store.accounted()
    clock = open_clock(config, accounted[1] if accounted else None)
    archive = FrameArchive(installation.state_directory)
    line = Pipeline(
        config.site(),
        config.config_hash(),
        store,
        archive,
        clock,
        config.burst_plan(),
        exposure=loop_of(config),
        machine=simulated_machine(clock) if has_stepped_clock(config) else this_machine(),
        late_row_done=reporter.late_row_done,
    )
    schedule = config.schedule.schedule()
    with ExitStack() as opened:
        source = opened.enter_context(closing(open_pair_source(config, clock)))
        reporter.recovering()
        last_utc = recover(line, schedule)
        store.add_event(clock.now_utc(), "started", f"version {VERSION}")
        _log.info("started", site=config.name, version=VERSION, state=str(archive.state))
        pause = Pause(source.close, changed=reporter.paused)
        opened.enter_context(control_socket(archive.state, pause))
        reporter.running(schedule.period_s, line.burst.limit_s if line.burst.count > 1 else 0.0)
        if line.exposure is not None:
            line.exposure.begin(source, last_known(store))
        prepare_cameras(source)
        circuit = Circuit(ended_before=len(store.events(clock.now_utc() - DAY, kind=PROCESS_SPENT)))
        runner = SlotRunner(line, schedule, source, stop, last_utc, reporter, pause, circuit)
        opened.callback(begin_to_close)
        try:
            done = runner.run(max_slots)
        except ProcessSpentError as error:
            note_spent(store, clock.now_utc(), error)
            raise
        finally:
            reporter.stopping()
    store.add_event(clock.now_utc(), "stopped", f"after {done} slots")
    mark_stop(store, clock.now_utc())
    _log.info("stopped", slots=done)


def note_spent(store: Store, now_utc: datetime, error: ProcessSpentError) -> None:
    """Enter in the history that this process gives up, so that the next one has more patience."""
    _log.error("process_spent", error=str(error), exit_code=int(error.exit_code))
    try:
        store.add_event(now_utc, PROCESS_SPENT, str(error))
    except StoreError as refused:
        _log.error("event_not_recorded", error=str(refused))


def prepare_cameras(source: FramePairSource) -> None:
    """Open the cameras before the first slot is due; one that is not there costs slots only."""
    try:
        source.prepare()
    except DriverError as error:
        _log.warning("cameras_not_ready", error=str(error))


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Give an event that SIGTERM and SIGINT set; the slot in progress ends first.

    The event is set by a thread of its own: a Python handler runs in between two steps of the
    main thread, and could find the event's lock held by the very thread that it interrupts.
    """
    stop = threading.Event()
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def wait() -> None:
        received = reader.recv(1)
        if received:
            _log.info("stopping", signal=signal.Signals(received[0]).name)
            stop.set()

    waiting = threading.Thread(target=wait, name="signals", daemon=True)
    waiting.start()
    before_fd = signal.set_wakeup_fd(writer.fileno())
    before = {number: signal.signal(number, _noted) for number in STOP_SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(before_fd)
        writer.close()
        waiting.join()
        reader.close()


def _noted(_number: int, _frame: FrameType | None) -> None:
    """Do nothing: the interpreter has written the signal's number to the wakeup descriptor."""


@contextmanager
def time_limit_to_close() -> Iterator[Callable[[], None]]:
    """Give a function that begins to count; when the block has ended, everything was closed.

    The limit is kept by a thread that needs nothing of Python: where a library hangs and holds
    the interpreter's lock, it prints where every thread is and ends the process (exit code 1).
    A slot in progress is not limited so, but by the service manager.
    """
    try:
        yield lambda: _end_within(CLOSE_LIMIT_S)
    finally:
        faulthandler.cancel_dump_traceback_later()


def _end_within(seconds: float) -> None:
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)


def main() -> int:
    """Run `dcamd` and give its exit code."""
    faulthandler.enable()  # a process that the watchdog aborts tells where each thread hung
    code = run(cli, "dcamd")
    _end_within(EXIT_LIMIT_S)
    return code


if __name__ == "__main__":
    sys.exit(main())
