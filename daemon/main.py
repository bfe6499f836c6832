"""`dcamd`, the daemon: opens everything, runs slots until asked to stop, closes everything."""

from __future__ import annotations

import faulthandler
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import TYPE_CHECKING, NoReturn

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.config.reading import Installation
from daemon.control.notify import Notifier
from daemon.control.requests import ControlRequests, given_by_signals
from daemon.control.run_state import make_runtime_directory
from daemon.devices import require_backend
from daemon.error_report import run
from daemon.heap import return_large_blocks
from daemon.lock import sole_writer
from daemon.log import configure_log
from daemon.version import VERSION

if TYPE_CHECKING:
    from daemon.slots.service import Station

CLOSE_LIMIT_S = 30.0
"""To close cameras and database, which have deadlines of their own."""


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

    Each slot of the schedule ends as a row or in a gap with its cause. Logs go to stderr. SIGHUP
    reads the config again; one that is wrong leaves the old one in force.
    """
    serve(options.installation, max_slots)


def serve(installation: Installation, max_slots: int | None = None) -> None:
    """Run the daemon on a site until asked to stop.

    Raises ConfigError, AlreadyRunningError, StoreError, DriverError, ProcessSpentError.
    """
    config = installation.config
    require_backend(config)
    # Numerics and database take a second and a half to load: help and a mistake in the config are
    # told before.
    from daemon.retention.guard import relieve
    from daemon.slots.reporting import Reporter
    from daemon.slots.service import Service
    from daemon.store.opening import damage_noted, open_checked_store
    from daemon.store.preparing import database_bytes

    configure_log(config.log.format, config.log.level)
    return_large_blocks()
    state = installation.state_directory
    requests: ControlRequests[Station] = ControlRequests()
    with given_by_signals(requests), sole_writer(state):
        relieve(state)
        reporter = Reporter(Notifier.from_environment(), make_runtime_directory(state))
        reporter.opening(database_bytes(state))
        with (
            time_limit_to_close() as begin_to_close,
            closing(open_checked_store(state, tell=reporter.salvaging)) as store,
            damage_noted(store),
        ):
            try:
                Service(installation, store, requests, reporter).run(max_slots, begin_to_close)
            finally:
                reporter.stopping()


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


def main() -> NoReturn:
    """Run `dcamd`, and end the process with its exit code."""
    faulthandler.enable()  # a process that the watchdog aborts shows where each thread hung
    code = run(cli, "dcamd")
    # Everything of ours is closed. Taking the interpreter down can wait for a library's thread,
    # and on an overloaded computer it takes longer than systemd gives.
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
