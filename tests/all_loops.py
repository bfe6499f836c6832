"""Compile every loop, for those who come after: a program, which reads its own results in silence.

Processes that start at the same time would each compile them by itself, which takes half a minute.
"""

from __future__ import annotations

import os

import daemon  # noqa: F401 - says where the compiled loops are kept
from core.calibration.calibrate import calibrate
from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board
from core.measurement import measure_pair
from core.recognition import find_targets
from core.site import CheckerboardTarget
from drivers.sim.settings import Sensor, SimSettings
from drivers.sim.world import World
from tests.core.scenes import grey, head_positions, small_site
from tests.core.sessions import all_views

SITE = small_site(sub_target=CheckerboardTarget(11, 8, 4.0, 50.0))
"""Few corners; their squares are wide enough for the loops of wide squares too."""
BITS = (8, 12)


def main() -> None:
    """See discs and corners at the same time, which is the most of it; then a site's whole life.

    Seen in images of 8 and of 16 bits; what comes after is the same for both. The zero of a
    calibration with the head is the mean of several looks, which has 16.
    """
    worlds = [World(SITE, SimSettings(seed=3, sensor=Sensor(bits=bits))) for bits in BITS]
    other = os.fork()
    if other == 0:
        see_discs(worlds)
        os._exit(0)
    see_corners(worlds)
    os.waitpid(other, 0)
    world = worlds[0]
    calibration, _ = calibrate(all_views(world, 5, head_positions(SITE, 6)), SITE)
    main, sub = (grey(world, role, world.settings.start_utc) for role in ("main", "sub"))
    measure_pair(main, sub, SITE, calibration)


def see_discs(worlds: list[World]) -> None:
    for world in worlds:
        find_targets(grey(world, "main", world.settings.start_utc), SITE)


def see_corners(worlds: list[World]) -> None:
    for world in worlds:
        image = grey(world, "sub", world.settings.start_utc)
        detect_board(image, Board.nominal(SITE.sub_target))


if __name__ == "__main__":
    main()
