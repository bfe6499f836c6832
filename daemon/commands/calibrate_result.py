"""What becomes of a calibration: stored, active or not, with its report for people and programs."""

from __future__ import annotations

import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import click

from daemon.calibration.page import write_report_files
from daemon.calibration.run import CalibrationRun, store_run
from daemon.commands.output import note, print_json, progress, say
from daemon.config.reading import Config
from daemon.datum.choice import find_zero
from daemon.errors import ExitCode
from daemon.store.database import Store
from daemon.store.queries.datum_fields import datum_fields
from daemon.store.records import DatumRecord


def judge_and_store(
    config: Config,
    store: Store,
    run: CalibrationRun,
    created_utc: datetime,
    *,
    accept: bool,
    as_json: bool,
    keeps_page: bool = False,
    board_untouched: bool = False,
) -> int:
    """Store a calibration, active if it may be, and print the report; give the exit code.

    keeps_page: write the report beside the frames too, which are ours to add to.
    board_untouched: the board stayed on the pier although there are lens views since.

    Only a question shows the report before it is stored: a reader of stdout that goes away
    (`| head`) must not cost the calibration.
    """
    run, zero = with_zero(config, store, run, created_utc, board_untouched=board_untouched)
    passed = run.report.passed
    asks = sys.stdin.isatty() and not (accept or as_json)
    if asks:
        say_report(run)
        question = "Make it the active calibration?"
        active = click.confirm(question, default=passed, err=True)
    else:
        active = accept or passed
    number = store_run(store, run, zero, config, created_utc, activate=active)
    page = write_page(run, config.name, number, created_utc, active=active) if keeps_page else None
    if accept and not passed:
        note("warning: accepted although it did not pass")
    if as_json:
        print_json(calibration_fields(run, zero, number, active=active))
        return ExitCode.DONE if passed or active else ExitCode.FAILED
    if not asks:
        say_report(run)
    say(f"Stored as calibration {number}, {'active now' if active else 'not active'}.")
    if page is not None:
        say(f"Report with figures: {page}")
    return ExitCode.DONE if passed or active else ExitCode.FAILED


def with_zero(
    config: Config,
    store: Store,
    run: CalibrationRun,
    created_utc: datetime,
    *,
    board_untouched: bool,
) -> tuple[CalibrationRun, DatumRecord]:
    """Find where the calibration's reference lies in the record's zero; the report says it."""
    with progress(None, "finding the zero") as steps:
        zero = find_zero(
            store,
            config.site(),
            run.reference,
            created_utc,
            board_untouched=board_untouched,
            on_step=steps.next,
        )
    report = replace(run.report, lines=(*run.report.lines, *zero.lines))
    return replace(run, report=report), zero.link


def write_page(
    run: CalibrationRun, site: str, number: int, created_utc: datetime, *, active: bool
) -> Path | None:
    """Write the report's files; a disk that refuses them does not cost the calibration."""
    try:
        return write_report_files(
            run.directory,
            run.report,
            site=site,
            number=number,
            active=active,
            created_utc=created_utc,
        )
    except OSError as error:
        note(f"warning: {run.directory}: the report's files could not be written ({error})")
        return None


def say_report(run: CalibrationRun) -> None:
    """Print the report, the verdict first."""
    for line in run.report.lines:
        say(line)


def calibration_fields(
    run: CalibrationRun, zero: DatumRecord, number: int, *, active: bool
) -> dict[str, object]:
    """A calibration for `--json`."""
    return {
        "command": "calibrate",
        "calibration": number,
        "active": active,
        "datum": datum_fields(zero),
        "method": run.calibration.method,
        "frames": run.directory,
        "passed": run.report.passed,
        "lines": run.report.lines,
        "figures": run.report.figures,
        "left_out": run.left_out,
    }
