"""`dcam-ctl export`: measurements as a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import nullcontext
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
from daemon.commands.output import Steps, note, progress
from daemon.errors import UsageError
from daemon.reports.table import opened_output, replacing, write_records
from daemon.store.database import ALWAYS, NEVER, open_store_readonly
from daemon.store.records import MeasurementRecord


@click.command(
    "export", epilog="\b\nExample:\n  dcam-ctl export --since 2026-03-01 --output march.csv"
)
@span_options
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["csv", "parquet", "netcdf"]),
    default="csv",
    show_default=True,
    help="What to write; parquet needs dcam's extra of that name.",
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
    # A table on stdout is seen to go on; a bar would be in its way.
    telling = nullcontext(None) if output is None else progress(None, "exporting rows")
    with open_store_readonly(options.state) as store, telling as steps:
        records = _counted(store.measurements(since or ALWAYS, until or NEVER), steps)
        if file_format == "csv":
            with opened_output(output) as table:
                count = write_records(records, table)
        else:
            count = _write_file(file_format, records, output, options)
    if output is not None:
        note(f"{count} rows written to {output}")


def _counted(
    records: Iterable[MeasurementRecord], steps: Steps | None
) -> Iterator[MeasurementRecord]:
    """The records, and word of how many there were so far."""
    for number, record in enumerate(records):
        if steps is not None and number % 1000 == 0:
            steps.at(number, None)
        yield record


def _write_file(
    file_format: str,
    records: Iterator[MeasurementRecord],
    output: Path | None,
    options: Options,
) -> int:
    from daemon.reports.files import write_netcdf, write_parquet

    if output is None:
        msg = f"--format {file_format} writes a file: give --output FILE"
        raise UsageError(msg)
    with replacing(output) as temporary:
        if file_format == "parquet":
            return write_parquet(records, temporary)
        return write_netcdf(records, temporary, options.config.name)
