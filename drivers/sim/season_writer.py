"""Write a season as frame sets: calibration, months of measure rows, and the board bonded again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from core.site import Site
from drivers.protocols import Role
from drivers.sim.frameset_writer import (
    MINUTE,
    View,
    calibration_views,
    head_positions_deg,
    write_views,
)
from drivers.sim.settings import SimSettings
from drivers.sim.world import World

PART_NAMES = ("first", "second", "third", "fourth")
"""Directories of the parts."""

WORK = timedelta(minutes=60)
"""From the last measure row of a part to the next one's lens views; nothing moves meanwhile."""

GOLDEN = 0.381966
"""Share of a day by which measure rows that are days apart move on, so that no hour is missed."""


@dataclass(frozen=True, slots=True)
class SeasonPlan:
    """How long, how many rows, and what is done to the rig on the way."""

    days: float = 145.0
    measure: tuple[int, ...] = (8, 6)
    """Measure rows of each part. Between two parts the board is bonded to the pier again and the
    rig calibrated again, while everything stands as in the last measure row before."""
    intrinsics: int = 10
    rig: int = 13
    refocused: tuple[Role, ...] = ()
    """Lenses that are refocused between two parts."""
    reach: float = 0.8
    """As `FrameSetPlan.reach`."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.measure) <= len(PART_NAMES) or min(self.measure) < 1:
            msg = f"a season of {self.measure} rows; give 1 to {len(PART_NAMES)} parts, none empty"
            raise ValueError(msg)
        span = timedelta(days=self.days) / sum(self.measure)
        if span < 2 * (WORK + (self.intrinsics + 1 + self.rig) * MINUTE):
            msg = f"{sum(self.measure)} rows in {self.days:g} days leave no time to calibrate"
            raise ValueError(msg)


@dataclass(frozen=True, slots=True)
class Season:
    """What was written."""

    world: World
    """As it is in the last part: board and lenses too."""
    parts: tuple[Path, ...]
    """The frame sets, in time order."""


def write_season(
    directory: Path, site: Site, settings: SimSettings, plan: SeasonPlan | None = None
) -> Season:
    """Render a season into `first`, `second` ... below a new or empty directory.

    The first calibration is before `settings.start_utc`, while everything rests; its reference is
    the zero of every part's truth.csv. Raises ValueError for a plan that does not work out.
    """
    plan = plan or SeasonPlan()
    world = World(site, settings)
    slots = measure_slots(settings.start_utc, plan)
    parts = []
    for number, count in enumerate(plan.measure):
        first = sum(plan.measure[:number])
        held_utc = slots[first - 1] if number else None
        if number:
            world.bond_board(number)
            for role in plan.refocused:
                world.refocus(role, number)
        parts.append(directory / PART_NAMES[number])
        views = _part(world, plan, number, slots[first : first + count], held_utc)
        write_views(parts[-1], world, views)
    return Season(world, tuple(parts))


def measure_slots(start_utc: datetime, plan: SeasonPlan) -> list[datetime]:
    """Spread the measure rows over the season and the hours of the day, to whole minutes."""
    count = sum(plan.measure)
    span_days = plan.days / count
    if span_days < 1.0:
        days = [k * span_days for k in range(count)]
    else:
        days = [math.floor(k * span_days) + GOLDEN * k % 1.0 for k in range(count)]
    return [start_utc + round(1440.0 * day) * MINUTE for day in days]


def _part(
    world: World, plan: SeasonPlan, number: int, slots: list[datetime], held_utc: datetime | None
) -> Iterator[View]:
    """Calibration, then measure rows; the world is held still while it is calibrated."""
    seed = [world.settings.seed, 6] + [number] * (number > 0)
    anywhere = head_positions_deg(world, np.random.default_rng(seed), plan.reach)
    rig_deg = [next(anywhere) for _ in range(plan.rig)]
    needed = (plan.intrinsics + 1 + plan.rig) * MINUTE
    first_utc = world.settings.start_utc - needed if held_utc is None else held_utc + WORK
    world.hold_still(held_utc)
    yield from calibration_views(first_utc, plan.intrinsics, rig_deg, number * plan.intrinsics)
    world.hold_still(None)
    for slot_utc in slots:
        yield View(slot_utc, "measure")
