"""`dcam-ctl calibrate --pan-tilt`: take the views with the head, and calibrate on them."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

from core.calibration.calibrate import Method
from daemon.calibration.guard import guarded_head
from daemon.calibration.interruption import explained_when_interrupted, stopping_cleanly
from daemon.calibration.lens_session import latest_lens_views
from daemon.calibration.opening import opened_devices
from daemon.calibration.positions import VIEWS
from daemon.calibration.run import (
    CalibrationRun,
    calibrate_frames,
    views_in,
    with_circumstances,
)
from daemon.calibration.session import (
    SIMULATED_LENS_VIEWS,
    CalibrationDevices,
    Session,
    serials_of,
    take_again,
    take_views,
    unfinished,
)
from daemon.commands.output import note, progress
from daemon.config.reading import Config
from daemon.control.control_socket import cameras_to_oneself
from daemon.errors import UsageError
from drivers.frameset import FrameSet, read_frame_set

MOST_TAKEN_AGAIN = 5
"""More positions than that which do not fit are no outliers."""


def calibrate_on(
    config: Config, directory: Path, method: Method, *, skew: bool = False
) -> tuple[CalibrationRun, datetime]:
    """Calibrate on a frame set; give the result, and when it was made."""
    frames = views_in(directory)
    with progress(len(frames.rows), "reading views") as steps:
        run = calibrate_frames(frames, config.site(), method, steps.next, steps.begin, skew=skew)
    run = with_circumstances(run, frames, config, serials_of(directory))
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
    begun = None if fresh else _session_to_resume(config, state)
    with ExitStack() as stack:
        stack.enter_context(stopping_cleanly())
        stack.enter_context(cameras_to_oneself(state, "dcam-ctl calibrate"))
        before = begun.rows if begun else lens.rows if lens else ()
        stack.enter_context(guarded_head(config))
        devices = stack.enter_context(opened_devices(config, before))
        if needs_lens and begun is None:
            require_lens_views(devices, lens)
        kept = "the views are kept, the same command continues from there"
        total = _views_to_take(devices, lens, begun)
        with explained_when_interrupted(kept), progress(total, "taking views", each=True) as steps:
            session = take_views(
                devices, state, config.config_hash(), lens, begun, steps.next, _warn
            )
        run, taken_utc = calibrate_on(config, session.directory, method, skew=skew)
        if 0 < len(run.rejected_positions) <= MOST_TAKEN_AGAIN:
            _take_rejected_again(devices, session, run)
            run, taken_utc = calibrate_on(config, session.directory, method, skew=skew)
        return run, devices.clock.now_utc() if config.has_stepped_clock else taken_utc


def _session_to_resume(config: Config, state: Path) -> Session | None:
    """Give the session that an interrupted run left, if there is one to continue."""
    now_utc = None if config.has_stepped_clock else datetime.now(UTC)
    begun = unfinished(state, config.config_hash(), now_utc)
    if begun is not None:
        taken = f"{len(begun.rows)} views have been taken"
        note(f"continuing {begun.directory}: {taken}; --fresh starts from the first view")
    return begun


def _views_to_take(
    devices: CalibrationDevices, lens: FrameSet | None, begun: Session | None
) -> int:
    if begun is not None:
        return len(begun.plan.positions) + 1 - len(begun.done)
    return VIEWS + 1 + (SIMULATED_LENS_VIEWS if devices.hold_board and lens is None else 0)


def _take_rejected_again(
    devices: CalibrationDevices, session: Session, run: CalibrationRun
) -> None:
    rejected = run.rejected_positions
    note(f"{len(rejected)} positions do not fit the others; they are taken again")
    with progress(len(rejected), "taking views again", each=True) as steps:
        take_again(devices, session, rejected, steps.next, _warn)


def _warn(problem: str) -> None:
    note(f"warning: {problem}")


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


def require_lens_views(devices: CalibrationDevices, lens: FrameSet | None) -> None:
    """Raise UsageError where lens views are neither there nor can be taken without a person."""
    if lens is None and devices.hold_board is None:
        msg = (
            "no lens views yet, and pan and tilt do not determine a lens; take them with "
            "dcam-ctl calibrate --intrinsics, or give --lens-views DIR or --without-lens-views"
        )
        raise UsageError(msg)
