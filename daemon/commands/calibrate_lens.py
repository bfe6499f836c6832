"""`dcam-ctl calibrate --intrinsics`: lens views, the board in the hand, and the lens they give."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from core.lens.lens_coverage import LensCoverage
from daemon.calibration.interruption import explained_when_interrupted, stopping_cleanly
from daemon.calibration.lens_session import take_lens_views
from daemon.calibration.lens_verdict import judge_lens
from daemon.calibration.opening import opened_bench
from daemon.commands.output import note, print_json, progress, say
from daemon.config.reading import Config
from daemon.control.control_socket import cameras_to_oneself
from daemon.errors import ExitCode, UsageError
from drivers.frameset import read_frame_set


def calibrate_intrinsics(
    config: Config, state: Path, directory: Path | None, *, as_json: bool
) -> int:
    """Take lens views, or read those of a frame set, and say what lens they give."""
    if directory is None:
        with ExitStack() as stack:
            stack.enter_context(stopping_cleanly())
            stack.enter_context(cameras_to_oneself(state, "dcam-ctl calibrate"))
            bench = stack.enter_context(opened_bench(config))
            kept = "these views are too few to be used; the same command starts again"
            stack.enter_context(explained_when_interrupted(kept))
            directory = take_lens_views(bench, state, show_lens_view)
        use = "uses the latest"
    else:
        use = f"--lens-views {directory} uses them"
    frames = read_frame_set(directory)
    views = frames.rows_of("intrinsics")
    if not views:
        msg = f"{directory}: holds no lens views (rows of role intrinsics)"
        raise UsageError(msg)
    with progress(len(views), "reading views") as steps:
        figures = judge_lens(frames, config.site(), steps.next, steps.begin)
    if as_json:
        print_json({"command": "calibrate", "frames": directory, **figures.fields})
    else:
        for line in figures.lines:
            say(line)
        say(f"Lens views in {directory}; dcam-ctl calibrate --pan-tilt {use}.")
    return ExitCode.DONE if figures.enough else ExitCode.FAILED


def show_lens_view(covered: LensCoverage, said: str) -> None:
    """Tell whoever holds the board how the last view turned out, and what to show next."""
    more = f"; next: {covered.suggestions[0]}" if covered.suggestions else "; enough"
    note(f"{said}; {covered.covered:.0%} of the image covered{more}")
