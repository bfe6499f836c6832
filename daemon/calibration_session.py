"""Taking a calibration's views: lens views with the board in the hand, the zero, head positions.

The views are written as a frame set, image by image and durably, so that a session that breaks
off leaves what it had, and a calibration can be repeated from it years later.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from core.site import Site
from daemon.store.durable import make_directory_durable, write_durable
from drivers.frameset import FrameRole, FrameSetRow, encode_png, write_table
from drivers.protocols import CapturedFrame, Clock, FramePairSource, PanTiltHead

FOLDER = "calibrations"
"""Below the state directory; one directory a session, named by its time in UTC."""

LENS_VIEWS = 12
PAN_POSITIONS, TILT_POSITIONS = 7, 3
"""21 positions, as in the paper."""
REACH = 0.8
"""Share of the way to where the main target would touch the edge of its image."""
MAX_ANGLE_DEG = 1.0
"""A wide main image would allow more, but the drift to be corrected is a tenth of a degree."""
SETTLE_S = 1.0
"""Between the end of a move and the exposure."""


@dataclass(frozen=True, slots=True)
class Rig:
    """What a session works with."""

    site: Site
    source: FramePairSource
    head: PanTiltHead
    clock: Clock
    hold_board: Callable[[int | None], None] | None
    """Brings the board into pose n before the sub-camera, and back to its place with None;
    None for a rig whose board cannot be taken off."""


def planned_positions(site: Site) -> list[tuple[float, float]]:
    """Pan and tilt of the rig views, degrees: a grid that keeps the main target in the image.

    Row by row to and fro, so that the head's moves stay short.
    """
    pan_deg, tilt_deg = _reach_deg(site)
    pans = np.linspace(-pan_deg, pan_deg, PAN_POSITIONS)
    tilts = np.linspace(-tilt_deg, tilt_deg, TILT_POSITIONS)
    return [
        (round(float(pan), 4), round(float(tilt), 4))
        for row, tilt in enumerate(tilts)
        for pan in (pans if row % 2 == 0 else pans[::-1])
    ]


def view_count(rig: Rig) -> int:
    """How many pairs a session takes."""
    return (LENS_VIEWS if rig.hold_board else 0) + 1 + PAN_POSITIONS * TILT_POSITIONS


def take_views(rig: Rig, state: Path, on_step: Callable[[str], None]) -> Path:
    """Take all views of a calibration; give the directory of their frame set.

    The rig ends where it began, also after an error, and the head is halted first. Raises
    HeadError, DeviceError, OSError.
    """
    directory = _new_directory(state / FOLDER / f"{rig.clock.now_utc():%Y%m%dT%H%M%SZ}")
    rows: list[FrameSetRow] = []
    try:
        for row in _views(rig, directory):
            rows.append(row)
            write_table(directory, rows)
            on_step(f"{row.role} view {len(rows)}")
    except BaseException:
        rig.head.halt()
        raise
    finally:
        if rig.hold_board is not None:
            rig.hold_board(None)
    rig.head.move_to(0.0, 0.0)
    return directory


def _new_directory(wanted: Path) -> Path:
    """Make a directory; simulated time can come twice, and no session overwrites another."""
    directory, number = wanted, 1
    while directory.exists():
        number += 1
        directory = wanted.with_name(f"{wanted.name}-{number}")
    make_directory_durable(directory)
    return directory


def _views(rig: Rig, directory: Path) -> Iterator[FrameSetRow]:
    if rig.hold_board is not None:
        for number in range(LENS_VIEWS):
            rig.hold_board(number)
            yield _take(rig, directory, "intrinsics", None)
        rig.hold_board(None)
    yield _take(rig, directory, "reference", (0.0, 0.0))
    for position in planned_positions(rig.site):
        yield _take(rig, directory, "rig", position)


def _take(
    rig: Rig, directory: Path, role: FrameRole, position: tuple[float, float] | None
) -> FrameSetRow:
    """Move, settle, expose, and put the images on the disk."""
    if position is not None:
        rig.head.move_to(*position)
    slot_utc = _settled(rig.clock)
    pair = rig.source.capture(slot_utc)
    reached = position and (rig.head.position_deg() or position)
    return FrameSetRow(
        slot_utc=slot_utc,
        role=role,
        main=_write(directory, slot_utc, "main", pair.main) if position else None,
        sub=_write(directory, slot_utc, "sub", pair.sub),
        pan_deg=round(reached[0], 4) if reached else None,
        tilt_deg=round(reached[1], 4) if reached else None,
    )


def _settled(clock: Clock) -> datetime:
    """Wait until the head has settled; give the whole second, a new one for every view."""
    ready = clock.now_utc() + timedelta(seconds=SETTLE_S)
    slot_utc = ready.replace(microsecond=0) + timedelta(seconds=1 if ready.microsecond else 0)
    clock.wait_until(slot_utc, threading.Event())
    return slot_utc


def _write(directory: Path, slot_utc: datetime, role: str, frame: CapturedFrame) -> str:
    name = f"{slot_utc:%H%M%S}_{role}.png"
    write_durable(directory / name, encode_png(frame.pixels, frame.bits))
    return name


def _reach_deg(site: Site) -> tuple[float, float]:
    camera, target = site.main, site.main_target
    half_view = np.array([camera.width_px, camera.height_px]) / 2.0 / camera.focal_px
    half_target_mm = np.abs(target.centres_mm).max(axis=0) + target.diameters_mm.max()
    free = np.degrees(half_view - half_target_mm / target.distance_mm)
    pan_deg, tilt_deg = np.clip(REACH * free, 0.0, MAX_ANGLE_DEG)
    return float(pan_deg), float(tilt_deg)
