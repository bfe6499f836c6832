"""`dcam-ctl export`: measurements as a table."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from daemon.commands.options import (
    Options,
    common_options,
    output_option,
    pass_options,
    span_options,
)
from daemon.commands.output import note
from daemon.export import opened_output, write_records
from daemon.store.database import ALWAYS, NEVER, open_store_readonly


@click.command(
    "export", epilog="\b\nExample:\n  dcam-ctl export --since 2026-03-01 --output march.csv"
)
@span_options
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["csv"]),
    default="csv",
    show_default=True,
    help="What to write.",
)
@output_option
@common_options
@pass_options
def command(
    options: Options,
    since: datetime | None,
    until: datetime | None,
    file_format: str,
    output: Path | None,
) -> None:
    """Write measurements, one line a slot, with everything that a row knows.

    flag: 1 good, 3 suspect (value given, reason named), 4 bad (value withheld), 9 missing.
    The daemon may run meanwhile.
    """
    del file_format  # one so far
    with open_store_readonly(options.state) as store, opened_output(output) as table:
        count = write_records(store.measurements(since or ALWAYS, until or NEVER), table)
    if output is not None:
        note(f"{count} rows written to {output}")
