"""`dcam-ctl export`: measurements as a table."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.commands.options import (
    Options,
    common_options,
    output_option,
    pass_options,
    site_option,
    span_options,
)
from daemon.commands.output import note, progress, shown_zone
from daemon.commands.output_files import new_file, opened_table
from daemon.errors import ConfigError, UsageError
from daemon.store.database import ALWAYS, NEVER, open_store_readonly

if TYPE_CHECKING:
    from daemon.reports.slot_table import SlotTable


@click.command(
    "export", epilog="\b\nExample:\n  dcam-ctl export --since 2026-03-01 --output march.csv"
)
@span_options
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["csv", "csv-plain", "parquet", "arrow", "netcdf"]),
    default="csv",
    show_default=True,
    help="What to write; csv-plain is for spreadsheets: few columns, local time; arrow is a "
    "stream. parquet and arrow need pyarrow, which an installation does not bring.",
)
@click.option(
    "--decimal",
    type=click.Choice(["point", "comma"]),
    default="point",
    show_default=True,
    help="Of csv-plain: comma also puts semicolons between columns.",
)
@output_option
@site_option
@common_options
@pass_options
def command(
    options: Options,
    since: datetime | None,
    until: datetime | None,
    file_format: str,
    decimal: str,
    output: Path | None,
) -> None:
    """Write every slot, one line each, with everything that its row knows; gaps too.

    flag: 1 good, 3 suspect (value given, reason named), 4 bad (value withheld), 9 missing. A slot
    in a gap has flag 9, the gap's cause as its reason, and in detail what else is known of it.
    docs/columns.md explains every column. Times are UTC but in csv-plain, where they are those of
    --tz. The daemon may run meanwhile.
    """
    from daemon.reports.slot_table import slot_table

    if decimal == "comma" and file_format != "csv-plain":
        msg = f"--decimal comma is for --format csv-plain, not for {file_format}"
        raise UsageError(msg)
    span = (since or ALWAYS, until or NEVER)
    # A table on stdout is seen to go on; a bar would be in its way.
    telling = nullcontext(None) if output is None else progress(None, "exporting rows")
    with open_store_readonly(options.state) as store, telling as steps:
        slots = slot_table(store, *span, steps.at if steps else lambda _done, _total: None)
        if file_format == "csv":
            from daemon.reports.table import write_slots

            with opened_table(output) as table:
                count = write_slots(slots, table)
        elif file_format == "csv-plain":
            from daemon.reports.plain import write_plain

            with opened_table(output) as table:
                count = write_plain(slots, table, shown_zone(), comma=decimal == "comma")
        elif file_format == "arrow" and output is None:
            from daemon.reports.files import write_arrow

            _require_pipe()
            count = write_arrow(slots, sys.stdout.buffer, _site_name(options))
        else:
            count = _write_file(file_format, slots, output, options)
    if output is not None:
        note(f"{count} rows written to {output}")


def _require_pipe() -> None:
    if sys.stdout.isatty():
        msg = "--format arrow is no text: give --output FILE, or pipe it to a program"
        raise UsageError(msg)


def _site_name(options: Options) -> str | None:
    """The site's name; a copied state is read without a config."""
    try:
        return options.config.name
    except ConfigError:
        return None


def _write_file(file_format: str, slots: SlotTable, output: Path | None, options: Options) -> int:
    if output is None:
        msg = f"--format {file_format} writes a file: give --output FILE"
        raise UsageError(msg)
    with new_file(output) as temporary:
        if file_format == "parquet":
            from daemon.reports.files import write_parquet

            return write_parquet(slots, temporary, _site_name(options))
        if file_format == "arrow":
            from daemon.reports.files import write_arrow

            with temporary.open("wb") as stream:
                return write_arrow(slots, stream, _site_name(options))
        from daemon.reports.netcdf import write_netcdf

        section = options.config.site_section
        return write_netcdf(slots, temporary, section.name, section.position_deg)
