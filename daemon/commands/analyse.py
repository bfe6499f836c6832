"""`dcam-ctl analyse`: what a record of months says."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    pass_options,
    site_option,
    span_options,
    utc_time,
    with_excluded_option,
)
from daemon.commands.output import note, print_json, print_table, progress, say, shown_zone
from daemon.commands.output_files import new_file, opened_table
from daemon.errors import UsageError
from daemon.store.database import open_store_readonly
from drivers.libraries import require_library

if TYPE_CHECKING:
    from daemon.analysis.days import Day
    from daemon.analysis.study import Study

FIGURES = (".png", ".svg")
COLUMNS = ("day", "min_mm", "mean_mm", "max_mm", "rows", "completeness")
_MOST_LINES = 40
"""Of days in the table for people; --json and --output have all."""


def _times(
    ctx: click.Context, parameter: click.Parameter, texts: Sequence[str]
) -> tuple[datetime, ...]:
    found = (utc_time(ctx, parameter, text) for text in texts)
    return tuple(time for time in found if time is not None)


@click.command(
    "analyse",
    epilog="\b\nExample:\n  dcam-ctl analyse --since 365d --reading deck --tz Europe/Berlin"
    "\n  dcam-ctl analyse --loaded 2026-03-01T06:00:00Z --predict 365",
)
@click.option("--point", default="main", show_default=True, help="A measured target's name.")
@click.option(
    "--axis",
    type=click.Choice(["x", "y"]),
    default="y",
    show_default=True,
    help="x: to the right; y: upwards.",
)
@click.option(
    "--reading",
    "readings",
    multiple=True,
    metavar="NAME",
    help="Regress this reading out; default: all in degC, else the main camera's temperature.",
)
@click.option(
    "--before-after",
    "events",
    multiple=True,
    callback=_times,
    metavar="TIME",
    help="Give the level after this event less that before.",
)
@click.option(
    "--loaded",
    callback=utc_time,
    metavar="TIME",
    help="Fit creep from this time on: the casting, the release of the scaffold.",
)
@click.option(
    "--predict",
    "predict_days",
    type=click.FloatRange(min=0.0, min_open=True),
    multiple=True,
    default=(365.0,),
    show_default=True,
    metavar="DAYS",
    help="Predict the creep so many days after loading.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="A figure (.png, .svg) or the table of days (.csv).",
)
@with_excluded_option
@span_options
@json_option
@site_option
@common_options
@pass_options
def command(
    options: Options,
    point: str,
    axis: str,
    readings: tuple[str, ...],
    events: tuple[datetime, ...],
    loaded: datetime | None,
    predict_days: tuple[float, ...],
    output: Path | None,
    with_excluded: bool,
    since: datetime | None,
    until: datetime | None,
    as_json: bool,
) -> None:
    """Give days, temperature with lag, trend, steps, before and after an event, and creep.

    Of good rows only, without what the quality ledger excludes. Everything but the days is fitted
    to hourly means with noise that remembers, and has its interval. The figure needs the extra
    `plot`. docs/analysis.md explains each number.
    """
    from daemon.analysis.fields import study_fields
    from daemon.analysis.reading import analyse_store
    from daemon.analysis.study import Asked

    suffix = _suffix(output)
    schedule = options.config.schedule
    asked = Asked(
        *(point, axis, readings, shown_zone(), events, loaded, predict_days),
        with_excluded=with_excluded,
    )
    with open_store_readonly(options.state) as store, progress(None, "reading rows") as steps:
        study = analyse_store(store, since, until, asked, schedule.period_s, steps.at)
    if output is not None:
        _write(output, suffix, study, options.config.name)
    if as_json:
        print_json({"command": "analyse", **study_fields(study)})
    else:
        _tell(study, asked.confidence)


def _suffix(output: Path | None) -> str:
    """What kind of file is wanted; looked at before the long work. Raises UsageError."""
    suffix = "" if output is None else output.suffix.lower()
    if output is not None and suffix not in {*FIGURES, ".csv"}:
        msg = f"--output {output}: name a file that ends in {', '.join(FIGURES)} or .csv"
        raise UsageError(msg)
    if suffix in FIGURES:
        require_library("matplotlib", "figure")
    return suffix


def _write(output: Path, suffix: str, study: Study, name: str) -> None:
    from daemon.analysis.figure import draw_study

    if suffix == ".csv":
        with opened_table(output) as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(COLUMNS)
            table.writerows(_cells(day) for day in study.days)
    else:
        title = f"{name}: {study.axis} of {study.point}"
        with new_file(output) as temporary:
            draw_study(study, title, temporary, file_format=suffix[1:], zone=shown_zone())
    note(f"{output}: {len(study.days)} days")


def _cells(day: Day) -> list[str]:
    values = (day.lowest_mm, day.mean_mm, day.highest_mm)
    shown = [f"{value:.4f}" if day.rows else "" for value in values]
    return [day.day.isoformat(), *shown, str(day.rows), f"{day.completeness:.4f}"]


def _tell(study: Study, confidence: float) -> None:
    from daemon.analysis.sentences import sentences

    shown = study.days[-_MOST_LINES:]
    head = (f"{study.point} {study.axis}", "min mm", "mean mm", "max mm", "rows", "complete")
    print_table(head, [_line(day) for day in shown])
    if len(shown) < len(study.days):
        say(f"the last {len(shown)} of {len(study.days)} days; --json and --output have all")
    say()
    for sentence in sentences(study, confidence):
        say(sentence)


def _line(day: Day) -> tuple[str, ...]:
    values = (day.lowest_mm, day.mean_mm, day.highest_mm)
    shown = [f"{value:+.3f}" if day.rows else "" for value in values]
    return (day.day.isoformat(), *shown, str(day.rows), f"{100.0 * day.completeness:.1f} %")
