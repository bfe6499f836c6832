"""What one pair shows of both targets, judged before it is used: found, sharp, lit, at rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from scipy.spatial import cKDTree

from core.arrays import FloatArray
from core.checkerboard.corners import LocatedBoard
from core.discs.disc_finder import Discs
from core.discs.plates import find_plates
from core.errors import BadLightError, CoreError, NotRecognisedError, TargetNotFoundError
from core.images import GreyImage
from core.recognition import (
    board_doubt,
    disc_doubt,
    recognise_board,
    recognise_mounted_board,
    recognise_targets,
    wanted_plates,
)
from core.site import Site
from daemon.errors import HardwareError
from daemon.slots.exposure import LOOK_PERIOD_S, next_second
from drivers.protocols import CapturedPair, Clock, FramePairSource

SETTLE_TIMEOUT_S = 30.0
STILL_PX = 0.05
"""A board that moves less between two looks is at rest: a hundredth of a pixel is noise."""
HELD_STILL_PX = 3.0
"""A board in the hand never rests; within an exposure of some ms this is a hundredth of it."""
_SHARP_PX = 3.0
_LEAST_CONTRAST = 0.12
_SATURATED_SHARE = 0.005
_CLEAN = 0.95
_ENOUGH_CORNERS = 0.9


@dataclass(frozen=True, slots=True)
class ViewCheck:
    """Both targets as one pair shows them; what is not found has its reason in `problems`."""

    pair: CapturedPair
    discs: Discs | None
    board: LocatedBoard | None
    problems: tuple[str, ...]
    """What makes the pair useless for a calibration, one line each: what, and what to do."""
    further: tuple[Discs | None, ...] = ()
    """The further targets in the order of the config; None where one is not seen."""


def see_pair(pair: CapturedPair, site: Site) -> ViewCheck:
    """Look at both targets of a pair."""
    main, sub = GreyImage(pair.main.pixels, pair.main.bits), _sub_image(pair)
    problems: list[str] = []
    discs = board = None
    further: tuple[Discs | None, ...] = ()
    try:
        discs, further = recognise_targets(main, site)
        problems += _main_problems(main, discs)
        doubt = disc_doubt(main, discs, site)
        problems += [] if doubt is None else [str(doubt)]
    except CoreError as error:
        known = isinstance(error, (NotRecognisedError, BadLightError))
        problems.append(f"{error}{'' if known else '; aim, focus and light the main camera'}")
        further = _further_alone(main, site)
    try:
        board = recognise_mounted_board(sub, site)
        problems += _sub_problems(sub, board)
        doubt = board_doubt(board, site)
        problems += [] if doubt is None else [str(doubt)]
    except (NotRecognisedError, BadLightError) as error:
        problems.append(str(error))
    except CoreError as error:
        problems.append(f"{error}; aim, focus and light the sub-camera")
    return ViewCheck(pair, discs, board, tuple(problems), further)


def further_problems(check: ViewCheck, site: Site) -> Iterator[str]:
    """What spoils further targets: they are not measured well then, the main one is."""
    image = GreyImage(check.pair.main.pixels, check.pair.main.bits)
    for extra, discs in zip(site.extra_targets, check.further, strict=True):
        if discs is not None:
            points_px = discs.points_px[discs.found]
            for problem in _exposure("main", image, discs.contrast_dn, points_px):
                yield problem.replace("main target", f'target "{extra.name}"', 1)


def _further_alone(image: GreyImage, site: Site) -> tuple[Discs | None, ...]:
    """The further targets where the main one is not seen."""
    try:
        found = find_plates(image, wanted_plates(site)) if site.extra_targets else [None]
    except TargetNotFoundError:
        return (None,) * len(site.extra_targets)
    return tuple(found[1:])


def see_board(pair: CapturedPair, site: Site) -> ViewCheck:
    """Look at the board alone, as for a lens view."""
    sub = _sub_image(pair)
    try:
        board = recognise_board(sub, site)
    except CoreError as error:
        return ViewCheck(pair, None, None, (str(error),))
    return ViewCheck(pair, None, board, tuple(_sub_problems(sub, board)))


def _sub_image(pair: CapturedPair) -> GreyImage:
    return GreyImage(pair.sub.pixels, pair.sub.bits)


def _main_problems(image: GreyImage, discs: Discs) -> Iterator[str]:
    if not discs.found.all():
        number = int((~discs.found).sum())
        yield (
            f"main target: {number} of its {len(discs.found)} discs not found; clear the view, or, "
            "if nothing hides them, correct target.main.centres_mm: the plate is another one"
        )
    elif (discs.explained_fraction < _CLEAN).any():
        yield "main target: something covers part of a disc; clear the view"
    yield from _exposure("main", image, discs.contrast_dn, discs.points_px[discs.found])
    yield from _focus("main", discs.blur_px)


def _sub_problems(image: GreyImage, board: LocatedBoard) -> Iterator[str]:
    if len(board.view.index) < _ENOUGH_CORNERS * board.visible:
        yield (
            f"sub target: {len(board.view.index)} of {board.visible} corners in the image can be "
            "measured; clear the view of the board"
        )
    yield from _exposure("sub", image, board.contrast_dn, board.view.points_px)
    yield from _focus("sub", board.blur_px)


def _exposure(
    role: str, image: GreyImage, contrast_dn: float, points_px: FloatArray
) -> Iterator[str]:
    """Judge the light on the target's own part of the image."""
    if contrast_dn < _LEAST_CONTRAST * image.saturation_dn:
        yield (
            f"{role} target: contrast of {contrast_dn:.0f} of {image.saturation_dn:.0f} grey "
            f"values; more light, or a longer [exposure] {role}_us"
        )
    low = np.maximum(points_px.min(axis=0).astype(int), 0)
    high = points_px.max(axis=0).astype(int) + 1
    part = image.pixels[low[1] : high[1], low[0] : high[0]]
    share = float((part >= image.saturation_dn).mean()) if part.size else 0.0
    if share > _SATURATED_SHARE:
        yield (
            f"{role} target: {share:.0%} of it is saturated; less light, or a shorter "
            f"[exposure] {role}_us"
        )


def _focus(role: str, blur_px: float) -> Iterator[str]:
    if blur_px > _SHARP_PX:
        yield (
            f"{role} camera: edges are {blur_px:.1f} px wide (1 sigma), more than {_SHARP_PX:g}; "
            "focus the lens, and fix its rings"
        )


# ---------------------------------------------------------------------------------- at rest


def settled_view_check(
    source: FramePairSource, clock: Clock, site: Site, *, board_only: bool = False
) -> tuple[datetime, ViewCheck]:
    """Look again and again until the board stands still; give the last look and its second.

    Judged by the sub-camera's own image: no head says when the rig it carries has stopped
    swinging. Raises HardwareError when it does not come to rest in time, DeviceError.
    """
    see = see_board if board_only else see_pair
    still_px = HELD_STILL_PX if board_only else STILL_PX
    before: FloatArray | None = None
    moved_px = np.inf
    first_s = clock.monotonic_s()
    while clock.monotonic_s() - first_s < SETTLE_TIMEOUT_S:
        slot_utc = next_second(clock)
        check = see(source.capture(slot_utc), site)
        if check.board is None:
            if before is None and clock.monotonic_s() - first_s < 2 * LOOK_PERIOD_S:
                continue  # perhaps still moving too fast to be seen
            return slot_utc, check
        points = check.board.view.points_px
        if before is not None:
            moved_px = common_motion_px(before, points)
            if moved_px < still_px:
                return slot_utc, check
        before = points
    msg = (
        f"the rig does not come to rest: after {SETTLE_TIMEOUT_S:g} s the board still moves by "
        f"{moved_px:.2f} px from one second to the next; look for wind, traffic or a loose bolt"
    )
    raise HardwareError(msg)


def common_motion_px(before: FloatArray, after: FloatArray) -> float:
    """How far a board's corners (n, 2) and (m, 2) went together, at the worst of them, px.

    Each corner is held against the nearest one before, so that no corner needs a name, and the
    motion common to them (an affine map) against their scatter. Half a square is the most that
    can be seen; a board that moves more is not at rest either.
    """
    distance, nearest = cKDTree(before).query(after)
    close = distance <= 3.0 * float(np.median(distance)) + 0.5
    design = np.column_stack([after, np.ones(len(after))])[close]
    moved = (after - before[nearest])[close]
    common = design @ np.linalg.lstsq(design, moved, rcond=None)[0]
    return float(np.hypot(*common.T).max())
