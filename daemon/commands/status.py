"""`dcam-ctl status`: one verdict for each thing that can go wrong; exit codes as Nagios plugins.

What is here and what the central database says are looked at by modules of their own, so that
neither waits for what only the other needs.
"""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

import click

from daemon.commands.options import (
    Options,
    at_option,
    common_options,
    json_option,
    pass_options,
    site_option,
    tz_option,
)
from daemon.commands.output import for_terminal, print_json
from daemon.errors import UsageError

if TYPE_CHECKING:
    from daemon.status.item import Level

WATCH_S = 10.0


@click.command(
    "status",
    epilog="\b\nExample:\n  dcam-ctl status\n  dcam-ctl status --json | jq .level",
)
@click.option(
    "--watch",
    "period_s",
    type=click.FloatRange(min=1),
    is_flag=False,
    flag_value=WATCH_S,
    metavar="SECONDS",
    help="Look again and again until Ctrl-C, every 10 s without a number.",
)
@click.option(
    "--fleet",
    is_flag=True,
    help="All sites of the central database of [fleet], worst first.",
)
@at_option
@json_option
@site_option
@tz_option
@common_options
@pass_options
def command(
    options: Options,
    period_s: float | None,
    fleet: bool,
    at_utc: datetime | None,
    as_json: bool,
) -> int:
    """Tell how the site is: is it measuring, last value and its age, what is wrong, disk.

    First a line for monitoring systems, then the answers in 80 columns, then each thing that was
    looked at. Exit code 0 OK, 1 warning, 2 critical, 3 unknown, as monitoring systems expect it.
    """
    if fleet or options.site is not None:
        from daemon.commands.status_fleet import look_at_fleet, look_at_site

        if period_s is not None or at_utc is not None or (fleet and options.site):
            msg = "--fleet and --site look once, at the present: one of them, no --watch, no --at"
            raise UsageError(msg)
        return (look_at_fleet if fleet else look_at_site)(options, as_json=as_json)
    from daemon.commands.status_here import look_here, watch_here

    if period_s is None:
        return look_here(options, at_utc, as_json=as_json)
    if as_json or at_utc is not None:
        msg = "--watch looks at the present, for people: leave out --json and --at"
        raise UsageError(msg)
    return watch_here(options, period_s)


def tell_failure(error: Exception, *, as_json: bool) -> Level:
    """Tell on stdout, where a monitoring system reads, why there is no verdict."""
    from daemon.status.verdict import no_verdict

    why = no_verdict(error)
    level, name = why.level, why.level.name
    if as_json:
        fields = {"level": name.lower(), "code": level, "error": why.text}
        print_json({"command": "status", **fields})
    else:
        print("\n".join(for_terminal(f"DCAM {name} - {why.text}")))
    return level
