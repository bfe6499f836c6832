"""`dcam-web`, the page: what the record shows, for browsers; it never writes to the record."""

from __future__ import annotations

import ctypes
import faulthandler
import sys

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note
from daemon.error_report import run
from daemon.version import VERSION


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
@click.version_option(VERSION, prog_name="dcam-web")
@common_options
@pass_options
def cli(options: Options, port: int | None) -> None:
    """Show the record in a browser, until SIGTERM or Ctrl-C.

    On this machine only, unless [web] in the config says otherwise: from elsewhere look through an
    SSH tunnel. The database is opened for reading only; dcamd may run or not.
    """
    from daemon.web.app import build_app
    from daemon.web.serving import make_server, open_socket
    from daemon.web.settings import settings_of

    settings = settings_of(options.installation)
    web = options.config.web
    app = build_app(settings)
    wanted = web.port if port is None else port
    with open_socket(web.host, wanted, "give another port in [web], or --port") as listening:
        bound = listening.getsockname()[1]
        name = f"[{web.host}]" if ":" in web.host else web.host
        note(f"http://{'localhost' if web.is_loopback else name}:{bound}/ shows the record")
        make_server(app).run([listening])


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
