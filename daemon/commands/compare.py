"""`dcam-ctl compare`: the record beside what others measured."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    pass_options,
    site_option,
    span_options,
    with_excluded_option,
)
from daemon.commands.output import print_json, print_table, say
from daemon.commands.reference_options import reference_options, span_s
from daemon.errors import WorkFailedError
from daemon.store.database import open_store_readonly
from daemon.text import utc_text
from daemon.times import EPOCH

if TYPE_CHECKING:
    from daemon.reports.beside_reference import PointComparison

_MOST_LINES = 40
"""Of times in the table for people; --json has all."""


@click.command(
    "compare", epilog="\b\nExample:\n  dcam-ctl compare --reference levelling.csv --zero fixed"
)
@reference_options(required=True)
@click.option(
    "--max-lag",
    "max_lag_s",
    callback=span_s,
    metavar="SPAN",
    help="Look how much later the reference moves, up to this either way: 6h.",
)
@with_excluded_option
@span_options
@json_option
@site_option
@common_options
@pass_options
def command(
    options: Options,
    reference: Path,
    zero: str,
    window_s: float,
    max_lag_s: float | None,
    with_excluded: bool,
    since: datetime | None,
    until: datetime | None,
    as_json: bool,
) -> None:
    """Hold good rows against levelling, LiDAR, a total station or a finite-element model.

    The CSV has the columns time (with its zone), x_mm and y_mm or one of them, sigma_mm (standard
    uncertainty, or sigma_x_mm and sigma_y_mm), and point for others than the main target. Axes and
    signs are the record's: x right, y up. Differences are rows less reference. E_n is a difference
    over its expanded uncertainty (k = 2): up to 1 the two agree. docs/report.md tells more.
    """
    from core.analysis.comparison import Zero
    from daemon.reports.beside_reference import Settings, compare_with_reference
    from daemon.reports.reference import read_reference

    wanted = Settings(window_s, Zero(zero), max_lag_s, with_excluded)
    measured = read_reference(reference)
    with open_store_readonly(options.state) as store:
        found = compare_with_reference(store.path, measured, wanted, since, until)
    if all(one.found is None for one in found):
        msg = (
            f"{reference}: no good row within {window_s:g} s of any of its times; check their "
            "zone, or give a longer --window"
        )
        if any(one.excluded.rows for one in found):
            msg = (
                f"{reference}: the quality ledger excludes all good rows within {window_s:g} s of "
                "its times; --with-excluded takes them in"
            )
        raise WorkFailedError(msg)
    if as_json:
        print_json(
            {"command": "compare", "reference": measured.name, "points": list(map(_fields, found))}
        )
        return
    for one in found:
        _tell(one)


def _fields(one: PointComparison) -> dict[str, Any]:
    found = None if one.found is None else one.found.to_dict()
    return {
        "point": one.point,
        "axis": one.axis,
        "times": one.times,
        "excluded": one.excluded.to_dict(),
        "comparison": found,
    }


def _tell(one: PointComparison) -> None:
    """Print one axis of one point: its times, then what they come to."""
    from daemon.reports.beside_reference import sentences

    if one.found is not None:
        shown = one.found.differences[-_MOST_LINES:]
        print_table(
            (f"{one.point} {one.axis}", "rows", "row", "reference", "difference", "U (k=2)", "E_n"),
            [
                (
                    utc_text(EPOCH + timedelta(seconds=each.time_s)),
                    str(each.rows),
                    f"{each.row_mm:+.3f}",
                    f"{each.reference_mm:+.3f}",
                    f"{each.difference_mm:+.3f}",
                    f"{2.0 * each.sigma_mm:.3f}",
                    "" if each.e_n is None else f"{each.e_n:.2f}",
                )
                for each in shown
            ],
        )
        if len(shown) < len(one.found.differences):
            say(f"the last {len(shown)} of {len(one.found.differences)}; --json has all")
    for sentence in sentences(one):
        say(sentence)
    say()
