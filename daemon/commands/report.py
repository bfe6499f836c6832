"""`dcam-ctl report`: the record of a span for the client, as HTML and PDF."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.commands.options import Options, common_options, pass_options, site_option, span_options
from daemon.commands.output import note, progress, shown_zone
from daemon.commands.output_files import new_file
from daemon.commands.reference_options import reference_options
from daemon.errors import UsageError
from daemon.status.coverage import coverage_text
from daemon.store.database import open_store_readonly

if TYPE_CHECKING:
    from daemon.reports.document import Document

SUFFIXES = (".html", ".pdf")
_MONTHLY = "--monthly writes the last finished month by itself"


@click.command("report", epilog="\b\nExample:\n  dcam-ctl report --since 30d --output march.pdf")
@span_options
@click.option(
    "--output",
    "outputs",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    multiple=True,
    help="A name that ends in .html or .pdf; both may be given.",
)
@reference_options()
@click.option(
    "--monthly",
    is_flag=True,
    help="Write the last finished month into the state directory's reports, unless it is there; "
    "run "
    "by a timer.",
)
@click.option(
    "--trials",
    type=click.IntRange(0, 1_000_000),
    default=None,
    metavar="N",
    help="Of the Monte Carlo that checks the statement of uncertainty; 0 leaves it out.",
)
@site_option
@common_options
@pass_options
def command(
    options: Options,
    since: datetime | None,
    until: datetime | None,
    outputs: tuple[Path, ...],
    reference: Path | None,
    zero: str,
    window_s: float,
    monthly: bool,
    trials: int | None,
) -> None:
    """Write the report for the client: what was measured, how far to trust it, every gap's cause.

    Figure, monthly statistics, site and method, completeness, calibrations and their zeros, a
    comparison with --reference, a statement of uncertainty after GUM and EA-4/02, events. HTML and
    PDF say the same; each is one file. [report] names client and contact. The daemon may run
    meanwhile.
    """
    from daemon.reports.page import ReportPlan, make_report
    from daemon.reports.statement import TRIALS

    if monthly:
        if outputs or since or until:
            msg = f"{_MONTHLY}: give neither --output nor --since nor --until with it"
            raise UsageError(msg)
        _write_month(options, reference, trials)
        return
    if not outputs:
        msg = "give --output FILE, a name that ends in .html or .pdf"
        raise UsageError(msg)
    for output in outputs:
        if output.suffix.lower() not in SUFFIXES:
            msg = f"--output {output}: name a file that ends in {' or '.join(SUFFIXES)}"
            raise UsageError(msg)
    plan = ReportPlan(
        since,
        until,
        shown_zone(),
        reference or options.config.report.reference,
        zero,
        window_s,
        TRIALS if trials is None else trials,
        tuple(dict.fromkeys(output.suffix.lower()[1:] for output in outputs)),
    )
    with open_store_readonly(options.state) as store, progress(None, "reading rows") as steps:
        report = make_report(options.installation, store, plan, steps.at, steps.begin)
    for output in outputs:
        with new_file(output) as temporary:
            temporary.write_bytes(_content(report.document, output.suffix.lower()))
        note(f"{output}: {coverage_text(report.history.coverage)}")


def _content(document: Document, suffix: str) -> bytes:
    from daemon.reports.page import write_html

    if suffix == ".html":
        return write_html(document).encode()
    from daemon.reports.pdf import write_pdf

    return write_pdf(document)


def _write_month(options: Options, reference: Path | None, trials: int | None) -> None:
    from daemon.reports.monthly import write_last_month

    site = options.installation
    if not site.config.report.monthly:
        note("[report] monthly = false: nothing is written")
        return
    for line in write_last_month(site, shown_zone(), reference, trials):
        note(line)
