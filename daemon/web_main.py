"""`dcam-web`, the page: what the record shows, for browsers; it never writes to the record."""

from __future__ import annotations

import ctypes
import faulthandler
import sys
from typing import TYPE_CHECKING

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note
from daemon.error_report import run
from daemon.version import VERSION

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from daemon.config.centre import Centre


@click.command(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="\b\nExample:\n  dcam-web\n"
    "  ssh -L 8766:localhost:8766 pier-3    then http://localhost:8766 in a browser",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    metavar="PORT",
    help="Instead of [web] port; 0 takes any that is free.",
)
@click.option(
    "--fleet",
    is_flag=True,
    help="All sites of the central database of [fleet]; a config without a site needs no --fleet.",
)
@click.version_option(VERSION, prog_name="dcam-web")
@common_options
@pass_options
def cli(options: Options, port: int | None, fleet: bool) -> None:
    """Show the record in a browser, until SIGTERM or Ctrl-C.

    On this machine only, unless [web] in the config says otherwise: from elsewhere look through an
    SSH tunnel. The database is opened for reading only; dcamd may run or not.
    """
    from daemon.web.serving import make_server, open_socket

    centre = options.centre
    fleet = fleet or centre.only_reads
    app = _fleet_app(centre) if fleet else _site_app(options)
    web = centre.web
    wanted = web.port if port is None else port
    with open_socket(web.host, wanted, "give another port in [web], or --port") as listening:
        bound = listening.getsockname()[1]
        name = f"[{web.host}]" if ":" in web.host else web.host
        what = "all sites" if fleet else "the record"
        note(f"http://{'localhost' if web.is_loopback else name}:{bound}/ shows {what}")
        make_server(app).run([listening])


def _site_app(options: Options) -> Starlette:
    from daemon.web.app import build_app
    from daemon.web.settings import settings_of

    return build_app(settings_of(options.installation))


def _fleet_app(centre: Centre) -> Starlette:
    from daemon.fleet.opening import address
    from daemon.web.fleet_app import build_fleet_app

    address(centre.fleet)  # no address, or no password: that is said now
    return build_fleet_app(centre)


_M_ARENA_MAX = -8
"""Of glibc's <malloc.h>."""


def _spare_memory() -> None:
    """Have all threads share one heap: each heap of its own keeps what it once needed."""
    choose = getattr(ctypes.CDLL(None), "mallopt", None)
    if choose is not None:
        choose(_M_ARENA_MAX, 1)


def main() -> None:
    """Run `dcam-web`, and end the process with its exit code."""
    _spare_memory()
    faulthandler.enable()
    sys.exit(run(cli, "dcam-web"))


if __name__ == "__main__":
    main()
