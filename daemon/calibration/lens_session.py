"""Taking lens views with the board in the hand: says what to show next, and when it is enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.checkerboard.board import Board
from core.checkerboard.resection import resect
from core.geometry.pose import Pose
from core.lens.intrinsics import nominal_lens
from core.lens.lens_coverage import ENOUGH_VIEWS, LensCoverage, lens_coverage
from core.site import Site
from daemon.calibration.session import FOLDER, new_directory, write_frame
from daemon.calibration.view_check import ViewCheck, common_motion_px, settled_view_check
from daemon.errors import HardwareError
from daemon.slots.exposure import ExposureLoop
from drivers.frameset import FrameSet, FrameSetRow, read_frame_set, write_table
from drivers.protocols import Clock, FramePairSource

SUFFIX = "-lens"
"""Of the session's directory, by which `--pan-tilt` finds the latest one."""
MOST_LOOKS = 300
"""Five minutes at one look a second; whoever needs longer begins again."""
_ANOTHER_SHARE = 0.04
"""A view is another one when the board has moved by this share of the image's width."""

OnView = Callable[[LensCoverage, str], None]
"""Called after each look with what is covered now, and what became of the look."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What lens views are taken with: no head, the board is in somebody's hand."""

    site: Site
    source: FramePairSource
    clock: Clock
    hold_board: Callable[[int | None], None] | None
    """Holds the board in pose n, and bonds it with None; None where a person does."""
    exposure: ExposureLoop | None = None
    """Follows the light on the board from look to look; None: fixed."""


@dataclass(slots=True)
class LensViews:
    """The views kept so far."""

    directory: Path
    rows: list[FrameSetRow] = field(default_factory=list)
    points_px: list[FloatArray] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)


def take_lens_views(bench: Bench, state: Path, on_view: OnView) -> Path:
    """Take lens views until they are enough; give the directory of their frame set.

    A view is kept, durably, when the board is found in it, is sharp and held still, and shows
    something else than the view before. Raises HardwareError when it is not enough after
    `MOST_LOOKS` looks, DeviceError.
    """
    views = LensViews(
        new_directory(state / FOLDER / f"{bench.clock.now_utc():%Y%m%dT%H%M%SZ}{SUFFIX}")
    )
    try:
        for look in range(MOST_LOOKS):
            if bench.hold_board is not None:
                bench.hold_board(look)
            said = _look(bench, views)
            covered = lens_coverage(views.points_px, views.poses, bench.site.sub)
            on_view(covered, said)
            if views.rows and not covered.suggestions:
                return views.directory
    finally:
        if bench.hold_board is not None:
            bench.hold_board(None)
    msg = (
        f"{len(views.rows)} lens views after {MOST_LOOKS} looks, still wanted: "
        f"{covered.suggestions[0]}; they are kept in {views.directory}"
    )
    raise HardwareError(msg)


def _look(bench: Bench, views: LensViews) -> str:
    """Look once; keep the view if it is of use. Says what became of it."""
    try:
        slot_utc, check = settled_view_check(bench.source, bench.clock, bench.site, board_only=True)
    except HardwareError:
        return "not kept: the board moves; hold it still"
    if bench.exposure is not None:
        bench.exposure.follow(bench.source, [check.pair], roles=["sub"])
    if check.problems or check.board is None:
        return f"not kept: {'; '.join(check.problems)}"
    points = check.board.view.points_px
    if views.points_px and _is_the_same(views.points_px[-1], points, bench.site.sub.width_px):
        return "not kept: as the view before; hold the board another way"
    pose = _rough_pose(bench, check)
    row = FrameSetRow(
        slot_utc,
        "intrinsics",
        None,
        write_frame(views.directory, slot_utc, "sub", check.pair.sub),
    )
    views.rows.append(row)
    views.points_px.append(points)
    views.poses.append(pose)
    write_table(views.directory, views.rows)
    return f"view {len(views.rows)} kept"


def _is_the_same(before: FloatArray, now: FloatArray, width_px: int) -> bool:
    """Whether the board is where it was; by its corners' middle first, which is not periodic."""
    middle_px = float(np.hypot(*(now.mean(axis=0) - before.mean(axis=0))))
    if middle_px > _ANOTHER_SHARE * width_px:
        return False
    return len(before) == len(now) and common_motion_px(before, now) < 2.0


def _rough_pose(bench: Bench, check: ViewCheck) -> Pose:
    """Where the board is held, by the lens as drawn: right to a degree or two."""
    board = Board.nominal(bench.site.sub_target)
    assert check.board is not None  # noqa: S101 - looked at by the caller
    return resect(nominal_lens(bench.site.sub), board.corners_mm, check.board.view).pose


def latest_lens_views(state: Path) -> FrameSet | None:
    """Give the latest lens views taken on this state directory, None if there are none.

    A session that was broken off is passed over: its few views must not stand in for all of an
    earlier one.
    """
    for directory in sorted((state / FOLDER).glob(f"*{SUFFIX}*"), reverse=True):
        frames = read_frame_set(directory) if (directory / "frames.csv").exists() else None
        if frames is not None and len(frames.rows_of("intrinsics")) >= ENOUGH_VIEWS:
            return frames
    return None
