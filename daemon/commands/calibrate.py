"""`dcam-ctl calibrate`: from lens views and rig positions to a calibration, judged and stored."""

from __future__ import annotations

import sys
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import click

from core.calibration import Method
from daemon.calibration_run import CalibrationRun, calibrate_frames, store_run, views_in
from daemon.calibration_session import Rig, take_views, view_count
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.commands.output import note, print_json, progress, say
from daemon.config import Config
from daemon.devices import open_clock, open_simulated_rig, require_backend
from daemon.errors import ExitCode, HardwareError, UsageError
from daemon.lock import sole_writer
from daemon.store.database import open_store

BEFORE_THE_STORY = timedelta(minutes=10)
"""A simulated rig is calibrated before anything happens to it: until then both targets rest."""


@click.command(
    "calibrate",
    epilog="\b\nExample:\n  dcam-ctl calibrate --from /data/calibration-2026-03-01 --accept",
)
@click.option(
    "--from",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Calibrate on a frame set: all its rows but those of role measure.",
)
@click.option(
    "--pan-tilt",
    is_flag=True,
    help="Move the head, take the views, keep them below the state directory, calibrate on them.",
)
@click.option(
    "--method",
    type=click.Choice([method.value for method in Method]),
    default=Method.RIGID.value,
    show_default=True,
    help="rigid: rigid rig with survey priors; paper: the nine parameters of Lee et al. 2020.",
)
@click.option("--skew", is_flag=True, help="Let the sub-camera's axes be skew (gamma of Eq. 10).")
@click.option("--accept", is_flag=True, help="Make the result active without asking.")
@json_option
@common_options
@pass_options
def command(
    options: Options,
    directory: Path | None,
    pan_tilt: bool,
    method: str,
    skew: bool,
    accept: bool,
    as_json: bool,
) -> int:
    """Calibrate lens, board and rig, say how far to trust the result, and store it.

    Views that are damaged or do not fit are left out and named. Motions that do not determine
    the model are refused, with the motion that is missing. Without --accept and without a
    terminal to ask on, the result becomes active only if it passed; exit code 1 if it did not.
    """
    if (directory is not None) == pan_tilt:
        msg = "give either --from DIR or --pan-tilt"
        raise UsageError(msg)
    config, state = options.config, options.state
    taken_utc = datetime.now(UTC)
    if directory is None:
        directory, taken_utc = capture_views(config, state)
    return calibrate_and_store(
        config,
        state,
        directory,
        Method(method),
        taken_utc,
        skew=skew,
        accept=accept,
        as_json=as_json,
    )


def capture_views(config: Config, state: Path) -> tuple[Path, datetime]:
    """Take the views with the pan-tilt head; give the directory of their frame set, and when.

    Raises HardwareError for a backend without a head, AlreadyRunningError, HeadError, DeviceError.
    """
    backend = require_backend(config)
    if backend != "simulated":
        msg = f"no pan-tilt head for backend {backend} in this version; use --from DIR"
        raise HardwareError(msg)
    clock = open_clock(config, begin_utc=config.simulation.start_utc - BEFORE_THE_STORY)
    with sole_writer(state, "dcam-ctl calibrate"):
        devices = open_simulated_rig(config, clock)
        rig = Rig(config.site(), devices.source, devices.head, clock, devices.world.hold_board)
        with (
            closing(devices.source),
            closing(devices.head),
            progress(view_count(rig), "taking views") as steps,
        ):
            return take_views(rig, state, steps.next), clock.now_utc()


def calibrate_and_store(
    config: Config,
    state: Path,
    directory: Path,
    method: Method,
    created_utc: datetime,
    *,
    skew: bool = False,
    accept: bool,
    as_json: bool,
) -> int:
    """Calibrate on a frame set, store the result, tell it; give the exit code.

    Only a question shows the report before it is stored: a reader of stdout that goes away
    (`| head`) must not cost the calibration.
    """
    frames = views_in(directory)
    asks = sys.stdin.isatty() and not (accept or as_json)
    with open_store(state) as store:
        with progress(len(frames.rows) + 1, "calibrating") as steps:
            run = calibrate_frames(frames, config.site(), method, steps.next, skew=skew)
        passed = run.report.passed
        if asks:
            say_report(run)
            question = "Make it the active calibration?"
            active = click.confirm(question, default=passed, err=True)
        else:
            active = accept or passed
        number = store_run(store, run, config, created_utc, activate=active)
    if accept and not passed:
        note("warning: accepted although it did not pass")
    if as_json:
        print_json(calibration_fields(run, number, active=active))
        return ExitCode.DONE if passed or active else ExitCode.FAILED
    if not asks:
        say_report(run)
    say(f"Stored as calibration {number}, {'active now' if active else 'not active'}.")
    return ExitCode.DONE if passed or active else ExitCode.FAILED


def say_report(run: CalibrationRun) -> None:
    """Print the report, the verdict first."""
    for line in run.report.lines:
        say(line)


def calibration_fields(run: CalibrationRun, number: int, *, active: bool) -> dict[str, object]:
    """A calibration for `--json`."""
    return {
        "command": "calibrate",
        "calibration": number,
        "active": active,
        "method": run.calibration.method,
        "frames": run.directory,
        "passed": run.report.passed,
        "lines": run.report.lines,
        "figures": run.report.figures,
        "left_out": run.left_out,
    }
