"""Write a complete frame set with its truth: lens views, reference, rig positions, measurements."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np

from core.site import Site
from drivers.frameset import (
    TEMPERATURES,
    FrameRole,
    FrameSetRow,
    encode_png,
    format_slot,
    write_table,
)
from drivers.protocols import Role
from drivers.sim.head import SimulatedHead
from drivers.sim.settings import SimSettings
from drivers.sim.world import World

TRUTH_TABLE = "truth.csv"
TRUTH_COLUMNS = ("slot_utc", "role", "x_mm", "y_mm", "false_x_mm", "false_y_mm", "case")
MOTION_COLUMNS = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
BREATH_COLUMNS = (*TEMPERATURES.values(), "air_c", "shift_u_px", "shift_v_px")
"""Of a world that breathes or has further plates."""
PLATE_COLUMNS = ("x_mm", "y_mm", "shift_u_px", "shift_v_px", "case")
"""Behind the name of each further plate and `_`."""

MINUTE = timedelta(minutes=1)


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
class View:
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
    world = World(site, settings)
    write_views(directory, world, _views(world, plan or FrameSetPlan()))
    return world


def write_views(directory: Path, world: World, views: Iterable[View]) -> None:
    """Render these views of a world into a new or empty directory, and leave its head at rest.

    The truth counts from the rig at rest. Where the world breathes, frames.csv has the cameras'
    temperatures.
    """
    directory.mkdir(parents=True, exist_ok=True)
    head = SimulatedHead(world)
    rows, truths = [], []
    for number, view in enumerate(views):
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
                extra=MappingProxyType(_temperature_cells(world, view)),
            )
        )
        if view.role in {"reference", "measure"}:
            truths.append(_truth_cells(world, view))
    head.move_to(0.0, 0.0)
    world.hold_board(None)
    write_table(directory, rows)
    columns = [name for name, _ in truths[0]] if truths else [*TRUTH_COLUMNS, *MOTION_COLUMNS]
    lines = [columns, *([cell for _, cell in truth] for truth in truths)]
    with (directory / TRUTH_TABLE).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


def head_reach_deg(site: Site) -> tuple[float, float]:
    """Pan and tilt that bring the main target's outermost disc to the edge of the main image."""
    camera, target = site.main, site.main_target
    half_view = np.array([camera.width_px, camera.height_px]) / 2.0 / camera.focal_px
    radius_mm = 0.75 * float(target.diameters_mm.max())
    half_target = (np.abs(target.centres_mm).max(axis=0) + radius_mm) / target.distance_mm
    pan, tilt = np.degrees(np.maximum(half_view - half_target, 0.0))
    return float(pan), float(tilt)


def head_positions_deg(
    world: World, rng: np.random.Generator, reach: float
) -> Iterator[tuple[float, float]]:
    """Random positions without end that use a share of the main camera's free field of view."""
    limits = world.settings.head
    reach_deg = reach * np.array(head_reach_deg(world.site))
    reach_deg = np.minimum(reach_deg, [limits.limit_pan_deg, limits.limit_tilt_deg])
    while True:
        pan_deg, tilt_deg = rng.uniform(-reach_deg, reach_deg)
        yield float(pan_deg), float(tilt_deg)


def calibration_views(
    first_utc: datetime,
    intrinsics: int,
    rig_deg: Iterable[tuple[float, float]],
    first_held: int = 0,
) -> Iterator[View]:
    """Lens views, reference and rig positions, a minute apart."""
    for number in range(intrinsics):
        yield View(first_utc + number * MINUTE, "intrinsics", held=first_held + number)
    reference_utc = first_utc + intrinsics * MINUTE
    yield View(reference_utc, "reference")
    for number, head_deg in enumerate(rig_deg, 1):
        yield View(reference_utc + number * MINUTE, "rig", head_deg=head_deg)


def _views(world: World, plan: FrameSetPlan) -> Iterator[View]:
    """The rows of a set in time order."""
    start_utc = world.settings.start_utc
    anywhere = head_positions_deg(
        world, np.random.default_rng([world.settings.seed, 6]), plan.reach
    )
    first_utc = start_utc - (plan.intrinsics + 1 + plan.rig) * MINUTE
    rig_deg = [next(anywhere) for _ in range(plan.rig)]
    yield from calibration_views(first_utc, plan.intrinsics, rig_deg)
    for number in range(plan.measure):
        at_utc = start_utc + number * plan.measure_every_min * MINUTE
        head_deg = next(anywhere) if plan.moved_by == "head" else (0.0, 0.0)
        yield View(at_utc, "measure", head_deg=head_deg)


def _write(directory: Path, number: int, role: Role, world: World, view: View) -> str | None:
    """Write one image and give its name; None where there is none to be had."""
    if not _has_image(role, world, view):
        return None
    name = f"{number:04d}_{role}.png"
    pixels = world.render(role, view.slot_utc)
    (directory / name).write_bytes(encode_png(pixels, world.settings.sensor.bits))
    return name


def _has_image(role: Role, world: World, view: View) -> bool:
    if role == "main" and view.role == "intrinsics":
        return False
    return not world.active("camera_loss", view.slot_utc, role)


def _temperature_cells(world: World, view: View) -> dict[str, str]:
    if not world.settings.breathes:
        return {}
    return {
        column: f"{world.reported_c(role, view.slot_utc):g}"
        if _has_image(role, world, view)
        else ""
        for role, column in TEMPERATURES.items()
    }


def _truth_cells(world: World, view: View) -> list[tuple[str, str]]:
    """One row of truth.csv as columns and their cells."""
    truth = world.truth(view.slot_utc)
    cells = [format_slot(view.slot_utc), view.role]
    cells += _numbers([*truth.displacement_mm, *truth.false_mm])
    cells += ["+".join(truth.cases) or "ok", *_numbers(truth.motion.vector)]
    row = list(zip((*TRUTH_COLUMNS, *MOTION_COLUMNS), cells, strict=True))
    if not world.settings.breathes and not truth.plates:
        return row
    warm = truth.temperature
    breath = _numbers([warm.main_c, warm.sub_c, warm.air_c, *truth.shift_px])
    row += zip(BREATH_COLUMNS, breath, strict=True)
    for name, plate in truth.plates.items():
        cells = _numbers([*plate.displacement_mm, *plate.shift_px])
        cells.append("hidden" if plate.hidden else "ok")
        row += zip((f"{name}_{column}" for column in PLATE_COLUMNS), cells, strict=True)
    return row


def _numbers(values: Iterable[float]) -> list[str]:
    return [repr(float(value)) for value in values]
