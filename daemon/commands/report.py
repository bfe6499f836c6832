"""`dcam-ctl report`: the record of a span as one HTML file that needs nothing else."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from daemon.commands.options import Options, common_options, pass_options, span_options
from daemon.commands.output import note, progress, shown_zone
from daemon.commands.output_files import new_file
from daemon.status.coverage import coverage_text
from daemon.store.database import open_store_readonly


@click.command("report", epilog="\b\nExample:\n  dcam-ctl report --since 30d --output march.html")
@span_options
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    required=True,
    help="The HTML file.",
)
@common_options
@pass_options
def command(options: Options, since: datetime | None, until: datetime | None, output: Path) -> None:
    """Write one HTML file: what was measured, how far to trust it, and every gap with its cause.

    State of the site, coverage, the figure of `plot`, monthly statistics of the good rows, reasons
    of the others, gaps, events, and the calibrations used. It may be sent by mail and opened
    anywhere. The daemon may run meanwhile.
    """
    from daemon.reports.history import read_history
    from daemon.reports.page import render

    schedule = options.config.schedule
    with open_store_readonly(options.state) as store, progress(None, "reading rows") as steps:
        history = read_history(
            store,
            since,
            until,
            period_s=schedule.period_s,
            offset_s=schedule.offset_s,
            tell=steps.at,
        )
        page = render(options.installation, store, history, shown_zone())
    with new_file(output) as temporary:
        temporary.write_text(page, encoding="utf-8")
    note(f"{output}: {coverage_text(history.coverage)}")
