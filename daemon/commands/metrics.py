"""`dcam-ctl metrics`: what status knows, for Prometheus."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path

import click

from daemon.alarm.armed import all_items
from daemon.commands.options import Options, at_option, common_options, output_option, pass_options
from daemon.durable import write_durable
from daemon.errors import UsageError
from daemon.reports.metrics import metrics_text, no_metrics_text
from daemon.status.facts import collect_facts
from daemon.status.verdict import no_verdict


@click.command(
    "metrics",
    epilog="\b\nExample:\n  dcam-ctl metrics --output /var/lib/prometheus/node-exporter/dcam.prom",
)
@at_option
@output_option
@common_options
@pass_options
def command(options: Options, at_utc: datetime | None, output: Path | None) -> None:
    """Write what status knows as metrics in Prometheus' text format.

    FILE is replaced whole, as node_exporter's textfile collector wants it; its name must end in
    .prom. Where the site cannot be looked at only the level is written, and the exit code tells.
    """
    if output is not None and output.suffix != ".prom":
        msg = f"--output {output}: node_exporter reads no such file; its name must end in .prom"
        raise UsageError(msg)
    try:
        facts = collect_facts(options.config, options.state, at_utc or datetime.now(UTC))
        text = metrics_text(facts, all_items(options.config, options.state, facts))
    except Exception as error:
        # Else the file would go on telling of the last good look.
        _write(output, no_metrics_text(no_verdict(error)))
        raise
    _write(output, text)


def _write(output: Path | None, text: bytes) -> None:
    """Replace the file whole. Raises OSError, which names what stands in the way."""
    if output is None:
        sys.stdout.flush()
        sys.stdout.buffer.write(text)  # UTF-8 by the format's rules, whatever the locale
        return
    try:
        write_durable(output, text)
    except OSError as error:
        error.filename = str(output.parent)
        raise
