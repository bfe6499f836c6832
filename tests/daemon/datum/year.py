"""A simulated year with five calibrations: bridge and rig move on between them."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from core.arrays import FloatArray
from core.site import Site
from drivers.frameset import FrameRole, FrameSetRow, encode_png, write_table
from drivers.protocols import Role
from drivers.sim.settings import AsBuilt, Motion, Scenario, SimSettings
from drivers.sim.world import World

CALIBRATIONS = 5
APART = timedelta(days=73)
LENS_VIEWS, RIG_VIEWS, ROWS = 8, 12, 4
MINUTE = timedelta(minutes=1)
YEAR_MIN = 525_600.0


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


def write_year(directory: Path, site: Site, *, bonded_again: bool = False) -> Year:
    """Render the sets; with `bonded_again` the board is taken off before each but the first.

    Lens views are those of before the first reference, as a board that stays bonded has no others.
    """
    motion = Motion(
        drift_mrad=0.3,
        drift_mm=0.4,
        drift_period_min=YEAR_MIN / 3.0,
        bridge_period_min=YEAR_MIN,
        bridge_small_mm=0.0,
    )
    settings = SimSettings(
        seed=3, scenarios=(Scenario("drift"), Scenario("bridge")), motion=motion, as_built=AsBuilt()
    )
    year = Year(directory, World(site, settings))
    for number in range(1, CALIBRATIONS + 1):
        if bonded_again and number > 1:
            year.world.slip_board(0.4 * number, -0.3 * number, 0.02 * number)
        _write_set(year, number, lens_views_again=bonded_again)
    return year


def _write_set(year: Year, number: int, *, lens_views_again: bool) -> None:
    directory = year.sets[number - 1]
    directory.mkdir(parents=True)
    at_utc = year.reference_utc(number)
    lens_utc = at_utc if lens_views_again else year.reference_utc(1)
    rng = np.random.default_rng(number)
    rows = [
        *(
            _row(year, directory, lens_utc - (LENS_VIEWS - held) * MINUTE, "intrinsics", held=held)
            for held in range(LENS_VIEWS)
        ),
        _row(year, directory, at_utc, "reference"),
        *(
            _row(year, directory, at_utc + (k + 1) * MINUTE, "rig", rng.uniform(-0.12, 0.12, 2))
            for k in range(RIG_VIEWS)
        ),
        *(_row(year, directory, slot_utc, "measure") for slot_utc in _row_slots(at_utc)),
    ]
    write_table(directory, rows)


def _row_slots(at_utc: datetime) -> Iterator[datetime]:
    """Rows after a calibration, the last one an hour before the next."""
    last = APART - timedelta(hours=1)
    for number in range(1, ROWS + 1):
        yield at_utc + (number * last) // ROWS


def _row(
    year: Year,
    directory: Path,
    slot_utc: datetime,
    role: FrameRole,
    head_deg: FloatArray | None = None,
    held: int | None = None,
) -> FrameSetRow:
    world = year.world
    world.hold_board(held)
    pan_deg, tilt_deg = (0.0, 0.0) if head_deg is None else head_deg.tolist()
    world.turn_head(pan_deg, tilt_deg)
    sides: tuple[Role, ...] = ("sub",) if role == "intrinsics" else ("main", "sub")
    names = {side: f"{slot_utc:%m%dT%H%M}_{role}_{side}.png" for side in sides}
    for side, name in names.items():
        pixels = world.render(side, slot_utc)
        (directory / name).write_bytes(encode_png(pixels, world.settings.sensor.bits))
    world.hold_board(None)
    world.turn_head(0.0, 0.0)
    return FrameSetRow(slot_utc, role, names.get("main"), names["sub"], pan_deg, tilt_deg)


def values_of(table: Path) -> tuple[list[datetime], FloatArray, FloatArray]:
    """Slots, x and y in mm, and their sigmas, of a file of `reprocess`."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["flag"] for row in rows] == ["1"] * len(rows), rows
    slots = [datetime.fromisoformat(row["slot_utc"]) for row in rows]
    mm = np.array([[float(row["x_mm"]), float(row["y_mm"])] for row in rows])
    sigma_mm = np.array([[float(row["sigma_x_mm"]), float(row["sigma_y_mm"])] for row in rows])
    return slots, mm, sigma_mm
