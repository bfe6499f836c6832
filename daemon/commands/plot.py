"""`dcam-ctl plot`: a figure of the record."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from daemon.commands.options import Options, common_options, pass_options, site_option, span_options
from daemon.commands.output import note, progress, shown_zone
from daemon.commands.output_files import new_file
from daemon.commands.reference_options import reference_options
from daemon.errors import UsageError
from daemon.status.coverage import coverage_text
from daemon.store.database import open_store_readonly
from drivers.libraries import require_library

SUFFIXES = (".png", ".svg")


@click.command("plot", epilog="\b\nExample:\n  dcam-ctl plot --since 7d --output week.svg")
@span_options
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    required=True,
    help="Where to draw: a name that ends in .png or .svg.",
)
@click.option(
    "--without-excluded",
    is_flag=True,
    help="Leave out what the quality ledger excludes; without it, it is hatched.",
)
@reference_options()
@site_option
@common_options
@pass_options
def command(
    options: Options,
    since: datetime | None,
    until: datetime | None,
    output: Path,
    without_excluded: bool,
    reference: Path | None,
    zero: str,
    window_s: float,
) -> None:
    """Draw raw and corrected displacement with sigma and flags, the rig's motion, and the gaps.

    Of a long span the lowest and the highest value of each column of the picture are drawn, so that
    every peak shows. A reference is drawn over them with its expanded uncertainty (k = 2), in the
    record's zero. The daemon may run meanwhile. Needs matplotlib.
    """
    from daemon.reports.beside_reference import read_beside
    from daemon.reports.figure import draw
    from daemon.reports.history import gap_spans, read_history

    if output.suffix.lower() not in SUFFIXES:
        msg = f"--output {output}: name a file that ends in {' or '.join(SUFFIXES)}"
        raise UsageError(msg)
    require_library("matplotlib", "figure")
    schedule = options.config.schedule
    with open_store_readonly(options.state) as store, progress(None, "reading rows") as steps:
        history = read_history(
            store,
            since,
            until,
            period_s=schedule.period_s,
            offset_s=schedule.offset_s,
            tell=steps.at,
            without_excluded=without_excluded,
        )
        span = history.since_utc, history.until_utc
        beside = read_beside(store.path, reference, zero, window_s, *span) if reference else None
    title = f"{options.config.name}: displacement of the target"
    with new_file(output) as temporary:
        draw(
            history.series,
            gap_spans(history.gaps),
            title,
            temporary,
            file_format=output.suffix.lower()[1:],
            reference=beside.marks if beside else (),
            zone=shown_zone(),
            excluded=history.excluded,
        )
    note(f"{output}: {coverage_text(history.coverage)}")
