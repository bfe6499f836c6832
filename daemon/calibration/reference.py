"""The zero of a calibration: the mean of several looks, as its noise is in every row alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np

from core.arrays import FloatArray
from core.errors import CalibrationError
from core.images import GreyImage, mean_image
from core.site import Site
from daemon.calibration.view_check import (
    STILL_PX,
    ViewCheck,
    common_motion_px,
    see_pair,
    settled_view_check,
)
from daemon.slots.exposure import next_second
from drivers.protocols import CapturedFrame, CapturedPair, Clock, FramePairSource

ZERO_LOOKS = 8
"""What the zero is the mean of."""
MAIN_STILL_PX = 0.3
"""How far the main target may be from its middle place: less than the lens blurs it anyway."""


def take_reference(
    source: FramePairSource, clock: Clock, site: Site, on_trouble: Callable[[str], None]
) -> tuple[datetime, ViewCheck]:
    """Look several times, a second apart; give the mean as 16-bit images, and its first second.

    Looks in which something moved, or was before a target, are left out. Raises CalibrationError
    when not even the first is clear, HardwareError when the rig does not come to rest,
    DeviceError.
    """
    slot_utc, first = settled_view_check(source, clock, site)
    if first.problems:
        raise CalibrationError("zero: " + "; ".join(first.problems))
    looks = [first]
    while len(looks) < ZERO_LOOKS:
        looks.append(see_pair(source.capture(next_second(clock)), site))
    used = looks_alike(looks)
    if len(used) < ZERO_LOOKS:
        on_trouble(
            f"zero: {ZERO_LOOKS - len(used)} of {ZERO_LOOKS} looks left out, in which something "
            f"moved or was in the way; the zero is the mean of {len(used)}"
        )
    zero = see_pair(mean_pair([look.pair for look in used]), site)
    for extra, discs in zip(site.extra_targets, zero.further, strict=True):
        if discs is None:
            on_trouble(
                f'zero: target "{extra.name}" is not seen, so that this calibration will not '
                "measure it; clear its view, then take the zero again"
            )
    return slot_utc, zero


def looks_alike(looks: Sequence[ViewCheck]) -> list[ViewCheck]:
    """Give the clear looks in which both targets are where they are in the middle one.

    The middle one is that whose main target is nearest to the median of all.
    """
    clear = [look for look in looks if not look.problems]
    at_px = np.array([_middle_px(look) for look in clear])
    away_px = np.hypot(*(at_px - np.median(at_px, axis=0)).T)
    middle = int(np.argmin(away_px))
    return [
        look
        for look, here_px in zip(clear, at_px, strict=True)
        if float(np.hypot(*(here_px - at_px[middle]))) < MAIN_STILL_PX
        and common_motion_px(_corners_px(clear[middle]), _corners_px(look)) < STILL_PX
    ]


def mean_pair(pairs: Sequence[CapturedPair]) -> CapturedPair:
    """Give the mean of pairs of one scene as a pair of 16 bits; all else is that of the first."""
    return replace(
        pairs[0],
        main=_mean_frame([pair.main for pair in pairs]),
        sub=_mean_frame([pair.sub for pair in pairs]),
    )


def _mean_frame(frames: Sequence[CapturedFrame]) -> CapturedFrame:
    mean = mean_image([GreyImage(frame.pixels, frame.bits) for frame in frames])
    return replace(frames[0], pixels=mean.pixels, bits=mean.bits)


def _middle_px(look: ViewCheck) -> FloatArray:
    assert look.discs is not None  # noqa: S101 - a clear look has found all of them
    return np.asarray(look.discs.points_px.mean(axis=0))


def _corners_px(look: ViewCheck) -> FloatArray:
    assert look.board is not None  # noqa: S101 - likewise
    return look.board.view.points_px
