"""`dcam-ctl calibrate`: from lens views and rig positions to a calibration, judged and stored."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import click

from core.calibration.calibrate import Method
from core.lens.lens_coverage import LensCoverage
from daemon.calibration.guard import guarded_head
from daemon.calibration.lens_session import Bench, latest_lens_views, take_lens_views
from daemon.calibration.lens_verdict import judge_lens
from daemon.calibration.page import write_report_files
from daemon.calibration.positions import VIEWS, Limits
from daemon.calibration.run import CalibrationRun, calibrate_frames, store_run, views_in
from daemon.calibration.session import (
    SIMULATED_LENS_VIEWS,
    CalibrationDevices,
    Session,
    take_again,
    take_views,
    unfinished,
)
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.commands.output import note, print_json, progress, say
from daemon.config.reading import Config
from daemon.control.control_socket import cameras_to_oneself
from daemon.devices import open_bench, open_calibration_rig, open_clock
from daemon.errors import ExitCode, UsageError, WorkFailedError
from daemon.lock import require_owner
from daemon.slots.exposure import loop_of
from daemon.store.database import Store, open_store
from drivers.frameset import FrameSet, FrameSetRow, read_frame_set

BEFORE_THE_STORY = timedelta(minutes=30)
"""A simulated rig is calibrated before anything happens to it: until then both targets rest."""
MOST_TAKEN_AGAIN = 5
"""More positions than that which do not fit are no outliers."""


@click.command(
    "calibrate",
    epilog="\b\nExample:\n  dcam-ctl calibrate --pan-tilt --lens-views /data/lens-2026-03-01\n"
    "  dcam-ctl calibrate --from /data/calibration-2026-03-01 --accept",
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
    "--intrinsics",
    is_flag=True,
    help="Take lens views, the board in the hand, until they are enough; or judge those of --from.",
)
@click.option(
    "--lens-views",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="With --pan-tilt: a frame set whose lens views (role intrinsics) are used; else the "
    "latest that --intrinsics took.",
)
@click.option(
    "--without-lens-views",
    is_flag=True,
    help="With --pan-tilt: take no lens views; the lens is then known as drawn only.",
)
@click.option("--fresh", is_flag=True, help="Begin anew, not where an interrupted run broke off.")
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
    intrinsics: bool,
    lens_views: Path | None,
    without_lens_views: bool,
    fresh: bool,
    method: str,
    skew: bool,
    accept: bool,
    as_json: bool,
) -> int:
    """Calibrate lens, board and rig, say how far to trust the result, and store it.

    Views that are damaged or do not fit are left out and named. Motions that do not determine
    the model are refused, with the motion that is missing. Without --accept and without a
    terminal to ask on, the result becomes active only if it passed; exit code 1 if it did not.

    With --pan-tilt every view is kept as soon as it is taken: an interrupted run goes on where
    it broke off. A running dcamd pauses meanwhile, and its slots are a gap of that cause.
    """
    if not pan_tilt and (lens_views is not None or without_lens_views or fresh):
        msg = "--lens-views, --without-lens-views and --fresh go with --pan-tilt"
        raise UsageError(msg)
    if intrinsics and not pan_tilt:
        return calibrate_intrinsics(options.config, options.state, directory, as_json=as_json)
    if (directory is not None) == pan_tilt:
        msg = "give one of --from DIR, --pan-tilt, --intrinsics"
        raise UsageError(msg)
    config, state = options.config, options.state
    require_owner(state)
    with open_store(state) as store:  # first: what cannot be stored need not be taken
        if directory is not None:
            run, taken_utc = calibrate_on(config, directory, Method(method), skew=skew)
        else:
            run, taken_utc = calibrate_with_head(
                config,
                state,
                Method(method),
                skew=skew,
                lens=None if without_lens_views else found_lens_views(state, lens_views),
                needs_lens=not without_lens_views,
                fresh=fresh,
            )
        return judge_and_store(
            config,
            store,
            run,
            taken_utc,
            accept=accept,
            as_json=as_json,
            keeps_page=directory is None,
        )


def calibrate_on(
    config: Config, directory: Path, method: Method, *, skew: bool = False
) -> tuple[CalibrationRun, datetime]:
    """Calibrate on a frame set; give the result, and when it was made."""
    frames = views_in(directory)
    with progress(len(frames.rows) + 1, "calibrating") as steps:
        run = calibrate_frames(frames, config.site(), method, steps.next, skew=skew)
    return run, datetime.now(UTC)


def calibrate_with_head(
    config: Config,
    state: Path,
    method: Method,
    *,
    skew: bool = False,
    lens: FrameSet | None = None,
    needs_lens: bool = True,
    fresh: bool = False,
) -> tuple[CalibrationRun, datetime]:
    """Take the views with the pan-tilt head and calibrate on them; views that do not fit again.

    Raises ConfigError and HardwareError where there is no head, AlreadyRunningError, HeadError,
    DeviceError, CalibrationError.
    """
    simulated_clock = config.has_stepped_clock
    begun = (
        None
        if fresh
        else unfinished(state, config.config_hash(), None if simulated_clock else datetime.now(UTC))
    )
    if begun is not None:
        note(
            f"going on with {begun.directory}: {len(begun.rows)} views are there; --fresh does not"
        )
    with ExitStack() as stack:
        stack.enter_context(stopping_cleanly())
        stack.enter_context(cameras_to_oneself(state, "dcam-ctl calibrate"))
        before = begun.rows if begun else lens.rows if lens else ()
        stack.enter_context(guarded_head(config))
        rig = stack.enter_context(opened_rig(config, before))
        if needs_lens and begun is None:
            require_lens_views(rig, lens)
        kept = "the views are kept, the same command goes on from there"
        with (
            told_when_interrupted(kept),
            progress(_steps(rig, lens, begun), "taking views") as steps,
        ):
            session = take_views(rig, state, config.config_hash(), lens, begun, steps.next, _tell)
        run, taken_utc = calibrate_on(config, session.directory, method, skew=skew)
        residual_ratios = _residual_ratios(run)
        if 0 < len(residual_ratios) <= MOST_TAKEN_AGAIN:
            note(f"{len(residual_ratios)} positions do not fit the others; they are taken again")
            with progress(len(residual_ratios), "taking views again") as steps:
                take_again(rig, session, residual_ratios, steps.next, _tell)
            run, taken_utc = calibrate_on(config, session.directory, method, skew=skew)
        return run, rig.clock.now_utc() if simulated_clock else taken_utc


@contextmanager
def told_when_interrupted(what_becomes_of_it: str) -> Iterator[None]:
    """Say what becomes of the views when Ctrl-C or SIGTERM ends the block."""
    try:
        yield
    except KeyboardInterrupt:
        msg = f"interrupted; {what_becomes_of_it}"
        raise WorkFailedError(msg) from None


def _steps(rig: CalibrationDevices, lens: FrameSet | None, begun: Session | None) -> int:
    if begun is not None:
        return len(begun.plan.positions) + 1 - len(begun.done)
    return VIEWS + 1 + (SIMULATED_LENS_VIEWS if rig.hold_board and lens is None else 0)


def _tell(trouble: str) -> None:
    note(f"warning: {trouble}")


def _residual_ratios(run: CalibrationRun) -> list[str]:
    """Slots of the rig views that were rejected."""
    named = (re.match(r"rig (\S+)", entry["view"]) for entry in run.report.figures["rejected"])
    return [match[1] for match in named if match]


def found_lens_views(state: Path, directory: Path | None) -> FrameSet | None:
    """Give the lens views to calibrate with: those named, else the latest taken, if any.

    Raises FrameSetError, UsageError.
    """
    if directory is None:
        return latest_lens_views(state)
    frames = read_frame_set(directory)
    if not frames.rows_of("intrinsics"):
        msg = f"{directory}: holds no lens views (rows of role intrinsics)"
        raise UsageError(msg)
    return frames


def require_lens_views(rig: CalibrationDevices, lens: FrameSet | None) -> None:
    """Raise UsageError where lens views are neither there nor can be taken without a person."""
    if lens is None and rig.hold_board is None:
        msg = (
            "no lens views yet, and pan and tilt do not determine a lens; take them with "
            "dcam-ctl calibrate --intrinsics, or give --lens-views DIR or --without-lens-views"
        )
        raise UsageError(msg)


def calibrate_intrinsics(
    config: Config, state: Path, directory: Path | None, *, as_json: bool
) -> int:
    """Take lens views, or read those of a frame set, and say what lens they give."""
    if directory is None:
        with ExitStack() as stack:
            stack.enter_context(stopping_cleanly())
            stack.enter_context(cameras_to_oneself(state, "dcam-ctl calibrate"))
            bench = stack.enter_context(opened_bench(config))
            kept = "these views are too few to be used; the same command begins anew"
            stack.enter_context(told_when_interrupted(kept))
            directory = take_lens_views(bench, state, show_lens_view)
        use = "uses the latest"
    else:
        use = f"--lens-views {directory} uses them"
    frames = read_frame_set(directory)
    views = frames.rows_of("intrinsics")
    if not views:
        msg = f"{directory}: holds no lens views (rows of role intrinsics)"
        raise UsageError(msg)
    with progress(len(views) + 1, "calibrating the lens") as steps:
        figures = judge_lens(frames, config.site(), steps.next)
    if as_json:
        print_json({"command": "calibrate", "frames": directory, **figures.fields})
    else:
        for line in figures.lines:
            say(line)
        say(f"Lens views in {directory}; dcam-ctl calibrate --pan-tilt {use}.")
    return ExitCode.DONE if figures.enough else ExitCode.FAILED


def show_lens_view(covered: LensCoverage, said: str) -> None:
    """Tell whoever holds the board what became of the look, and what to show next."""
    more = f"; next: {covered.suggestions[0]}" if covered.suggestions else "; enough"
    note(f"{said}; {covered.covered:.0%} of the image covered{more}")


@contextmanager
def opened_rig(config: Config, before: Sequence[FrameSetRow]) -> Iterator[CalibrationDevices]:
    """Open cameras and head for a session; simulated time goes on after the views before it.

    Raises as `open_calibration_rig`.
    """
    begin_utc = config.simulation.start_utc - BEFORE_THE_STORY
    if before:
        begin_utc = max(begin_utc, before[-1].slot_utc + timedelta(seconds=1))
    clock = open_clock(config, begin_utc=begin_utc)
    devices = open_calibration_rig(config, clock)
    with closing(devices.source), closing(devices.head):
        yield CalibrationDevices(
            config.site(),
            devices.source,
            devices.head,
            Limits(*config.pan_tilt.room_deg()),
            clock,
            devices.hold_board,
            loop_of(config),
        )


@contextmanager
def opened_bench(config: Config) -> Iterator[Bench]:
    """Open what lens views need: the cameras, and no head."""
    begin_utc = config.simulation.start_utc - BEFORE_THE_STORY
    clock = open_clock(config, begin_utc=begin_utc)
    source, hold_board = open_bench(config, clock)
    with closing(source):
        yield Bench(config.site(), source, clock, hold_board, loop_of(config))


@contextmanager
def stopping_cleanly() -> Iterator[None]:
    """Let SIGTERM and a closed terminal end the block as Ctrl-C does: the head is halted."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = {
        number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def judge_and_store(
    config: Config,
    store: Store,
    run: CalibrationRun,
    created_utc: datetime,
    *,
    accept: bool,
    as_json: bool,
    keeps_page: bool = False,
) -> int:
    """Store a calibration, active if it may be, and tell it; give the exit code.

    keeps_page: write the report beside the frames too, which are ours to add to.

    Only a question shows the report before it is stored: a reader of stdout that goes away
    (`| head`) must not cost the calibration.
    """
    passed = run.report.passed
    asks = sys.stdin.isatty() and not (accept or as_json)
    if asks:
        say_report(run)
        question = "Make it the active calibration?"
        active = click.confirm(question, default=passed, err=True)
    else:
        active = accept or passed
    number = store_run(store, run, config, created_utc, activate=active)
    page = write_page(run, config.name, number, created_utc, active=active) if keeps_page else None
    if accept and not passed:
        note("warning: accepted although it did not pass")
    if as_json:
        print_json(calibration_fields(run, number, active=active))
        return ExitCode.DONE if passed or active else ExitCode.FAILED
    if not asks:
        say_report(run)
    say(f"Stored as calibration {number}, {'active now' if active else 'not active'}.")
    if page is not None:
        say(f"Report with figures: {page}")
    return ExitCode.DONE if passed or active else ExitCode.FAILED


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
