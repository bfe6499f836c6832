"""Write a complete frame set with its truth: lens views, reference, rig positions, measurements."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np

from core.site import Site
from drivers.frameset import FrameRole, FrameSetRow, encode_png, format_slot, write_table
from drivers.protocols import Role
from drivers.sim.head import SimulatedHead
from drivers.sim.settings import SimSettings
from drivers.sim.truth import Truth
from drivers.sim.world import World

TRUTH_TABLE = "truth.csv"
TRUTH_COLUMNS = ("slot_utc", "role", "x_mm", "y_mm", "false_x_mm", "false_y_mm", "case")
MOTION_COLUMNS = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")


@dataclass(frozen=True, slots=True)
class FrameSetPlan:
    """How many rows of each role, and what moves the rig in the measure rows."""

    intrinsics: int = 12
    rig: int = 21
    measure: int = 12
    measure_every_min: float = 60.0
    """Between measure rows; the first is at the settings' `start_utc`."""
    moved_by: Literal["scenarios", "head"] = "scenarios"
    """`head`: random head positions too, as in a laboratory."""
    reach: float = 0.8
    """Share of the main camera's free field of view that the head makes use of."""


@dataclass(frozen=True, slots=True)
class _View:
    """One row to be."""

    slot_utc: datetime
    role: FrameRole
    held: int | None = None
    """Which pose of the board in the hand."""
    head_deg: tuple[float, float] = (0.0, 0.0)


def write_frame_set(
    directory: Path, site: Site, settings: SimSettings, plan: FrameSetPlan | None = None
) -> World:
    """Render a set into a new or empty directory: images, frames.csv, truth.csv.

    Calibration rows come a minute apart before `settings.start_utc`, while everything rests; the
    scenarios' minutes count from the first measure row. Gives the world, which knows the truth.
    """
    directory.mkdir(parents=True, exist_ok=True)
    world = World(site, settings)
    head = SimulatedHead(world)
    rows, truths = [], []
    for number, view in enumerate(_views(world, plan or FrameSetPlan())):
        world.hold_board(view.held)
        head.move_to(*view.head_deg)
        pan_deg, tilt_deg = head.position_deg()
        at_known_angles = view.role in {"reference", "rig"}
        rows.append(
            FrameSetRow(
                slot_utc=view.slot_utc,
                role=view.role,
                main=_write(directory, number, "main", world, view),
                sub=_write(directory, number, "sub", world, view),
                pan_deg=round(pan_deg, 4) if at_known_angles else None,
                tilt_deg=round(tilt_deg, 4) if at_known_angles else None,
            )
        )
        if view.role in {"reference", "measure"}:
            truths.append(_truth_cells(view, world.truth(view.slot_utc)))
    head.move_to(0.0, 0.0)
    write_table(directory, rows)
    with (directory / TRUTH_TABLE).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([TRUTH_COLUMNS + MOTION_COLUMNS, *truths])
    return world


def head_reach_deg(site: Site) -> tuple[float, float]:
    """Pan and tilt that bring the main target's outermost disc to the edge of the main image."""
    camera, target = site.main, site.main_target
    half_view = np.array([camera.width_px, camera.height_px]) / 2.0 / camera.focal_px
    radius_mm = 0.75 * float(target.diameters_mm.max())
    half_target = (np.abs(target.centres_mm).max(axis=0) + radius_mm) / target.distance_mm
    pan, tilt = np.degrees(np.maximum(half_view - half_target, 0.0))
    return float(pan), float(tilt)


def _views(world: World, plan: FrameSetPlan) -> Iterator[_View]:
    """The rows of a set in time order."""
    settings, minute = world.settings, timedelta(minutes=1)
    reach_deg = plan.reach * np.array(head_reach_deg(world.site))
    reach_deg = np.minimum(reach_deg, [settings.head.limit_pan_deg, settings.head.limit_tilt_deg])
    rng = np.random.default_rng([settings.seed, 6])

    def anywhere() -> tuple[float, float]:
        pan_deg, tilt_deg = rng.uniform(-reach_deg, reach_deg)
        return float(pan_deg), float(tilt_deg)

    slot = settings.start_utc - (plan.intrinsics + 1 + plan.rig) * minute
    for number in range(plan.intrinsics):
        yield _View(slot + number * minute, "intrinsics", held=number)
    slot += plan.intrinsics * minute
    yield _View(slot, "reference")
    for number in range(plan.rig):
        yield _View(slot + (number + 1) * minute, "rig", head_deg=anywhere())
    for number in range(plan.measure):
        at = settings.start_utc + number * plan.measure_every_min * minute
        yield _View(at, "measure", head_deg=anywhere() if plan.moved_by == "head" else (0.0, 0.0))


def _write(directory: Path, number: int, role: Role, world: World, view: _View) -> str | None:
    """Write one image and give its name; None where there is none to be had."""
    if role == "main" and view.role == "intrinsics":
        return None
    if world.active("camera_loss", view.slot_utc, role):
        return None
    name = f"{number:04d}_{role}.png"
    pixels = world.render(role, view.slot_utc)
    (directory / name).write_bytes(encode_png(pixels, world.settings.sensor.bits))
    return name


def _truth_cells(view: _View, truth: Truth) -> list[str]:
    case = "+".join(truth.cases) or "ok"
    numbers = [*truth.displacement_mm, *truth.false_mm]
    cells = [format_slot(view.slot_utc), view.role, *(repr(float(x)) for x in numbers), case]
    return cells + [repr(float(x)) for x in truth.motion.vector]
