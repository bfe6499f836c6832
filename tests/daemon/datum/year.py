"""A simulated year with five calibrations: bridge and rig move on between them."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.site import Site
from drivers.frameset import FrameRole, FrameSetRow, encode_png, write_table
from drivers.protocols import Role
from drivers.sim.settings import Motion, Scenario, SimSettings
from drivers.sim.world import World

CALIBRATIONS = 5
BONDED_AGAIN = frozenset({4, 5})
"""Calibrations before which the board was taken off the pier."""
APART = timedelta(days=73)
LENS_VIEWS, RIG_VIEWS, ROWS = 6, 8, 2
MINUTE = timedelta(minutes=1)
YEAR_MIN = 525_600.0
FIXED_PLATE = """
[[target.extra]]
name = "abutment"
role = "fixed"
kind = "circles"
centres_mm = [[-9.0, 6.5], [9.0, 6.5], [0.0, 0.0], [-9.0, -6.5], [9.0, -6.5]]
diameter_mm = 5.0
distance_mm = 11500.0
"""
NOTHING_CHANGES = """
[stability]
cameras_urad_per_k = 0
cameras_urad_per_sqrt_day = 0
board_urad_per_k = 0
board_urad_per_sqrt_day = 0
board_expansion_per_k = 0
main_px_per_k = 0
sub_px_per_k = 0
main_scale_per_k = 0
air_gradient_k_per_m = 0
"""
"""The simulated rig is as rigid as that: what is left of the sigmas is that of images."""


@dataclass(frozen=True, slots=True)
class Year:
    """Frame sets of one world, one for each calibration, with the rows until the next one."""

    directory: Path
    world: World

    @property
    def sets(self) -> list[Path]:
        """In the order of time."""
        return [self.directory / f"set-{number}" for number in range(1, CALIBRATIONS + 1)]

    def reference_utc(self, number: int) -> datetime:
        """When calibration `number`, from 1, has its reference."""
        return self.world.settings.start_utc + timedelta(days=10) + (number - 1) * APART

    def truth_mm(self, slots_utc: list[datetime]) -> FloatArray:
        """(n, 2) true displacement since the first reference."""
        first = self.reference_utc(1)
        return np.array([self.world.truth(t, first).displacement_mm for t in slots_utc])


def write_year(directory: Path, site: Site) -> Year:
    """Render the sets. A board that is bonded again is somewhere else, and has new lens views."""
    motion = Motion(
        drift_mrad=0.3,
        drift_mm=0.4,
        drift_period_min=YEAR_MIN / 3.0,
        bridge_period_min=YEAR_MIN,
        bridge_small_mm=0.0,
    )
    scenarios = (Scenario("drift"), Scenario("bridge"))
    year = Year(directory, World(site, SimSettings(seed=3, scenarios=scenarios, motion=motion)))
    lens: list[FrameSetRow] = []
    for number, folder in enumerate(year.sets, start=1):
        folder.mkdir(parents=True)
        if number in BONDED_AGAIN:
            year.world.slip_board(0.4 * number, -0.3 * number, 0.02 * number)
        if number == 1 or number in BONDED_AGAIN:
            lens, taken_in = list(_lens_views(year, folder, year.reference_utc(number))), folder
        else:
            for row in lens:
                shutil.copy(taken_in / str(row.sub), folder)
        write_table(folder, [*lens, *_other_rows(year, folder, number)])
    return year


def _lens_views(year: Year, folder: Path, before_utc: datetime) -> Iterator[FrameSetRow]:
    for held in range(LENS_VIEWS):
        at_utc = before_utc - (LENS_VIEWS - held) * MINUTE
        yield _row(year, folder, at_utc, "intrinsics", held=held)


def _other_rows(year: Year, folder: Path, number: int) -> Iterator[FrameSetRow]:
    """Reference, rig positions, and rows of which the last is an hour before the next one."""
    at_utc, rng = year.reference_utc(number), np.random.default_rng(number)
    yield _row(year, folder, at_utc, "reference")
    for view in range(1, RIG_VIEWS + 1):
        yield _row(year, folder, at_utc + view * MINUTE, "rig", rng.uniform(-0.05, 0.05, 2))
    for row in range(1, ROWS + 1):
        slot_utc = at_utc + row * (APART - timedelta(hours=1)) // ROWS
        yield _row(year, folder, slot_utc, "measure")


def _row(
    year: Year,
    folder: Path,
    slot_utc: datetime,
    role: FrameRole,
    head_deg: FloatArray | None = None,
    held: int | None = None,
) -> FrameSetRow:
    world = year.world
    pan_deg, tilt_deg = (0.0, 0.0) if head_deg is None else head_deg.tolist()
    world.hold_board(held)
    world.turn_head(pan_deg, tilt_deg)
    sides: tuple[Role, ...] = ("sub",) if role == "intrinsics" else ("main", "sub")
    names = {side: f"{slot_utc:%m%dT%H%M}_{role}_{side}.png" for side in sides}
    for side, name in names.items():
        pixels = world.render(side, slot_utc)
        (folder / name).write_bytes(encode_png(pixels, world.settings.sensor.bits))
    world.hold_board(None)
    world.turn_head(0.0, 0.0)
    return FrameSetRow(slot_utc, role, names.get("main"), names["sub"], pan_deg, tilt_deg)


@dataclass(frozen=True, slots=True)
class Values:
    """What `reprocess` wrote of a set's rows."""

    slots_utc: list[datetime]
    mm: FloatArray
    """(n, 2)."""
    sigma_mm: FloatArray


def values_of(table: Path) -> Values:
    """Read a table, of which each row must be good."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["flag"] for row in rows] == ["1"] * len(rows), [row["reasons"] for row in rows]

    def pairs(x: str, y: str) -> FloatArray:
        return np.array([[float(row[x]), float(row[y])] for row in rows])

    return Values(
        [datetime.fromisoformat(row["slot_utc"]) for row in rows],
        pairs("x_mm", "y_mm"),
        pairs("sigma_x_mm", "sigma_y_mm"),
    )
