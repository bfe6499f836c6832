"""Compile every loop, for those who come after: a program, which reads its own results in silence.

Processes that start at the same time would each compile them by itself, which takes a minute.
"""

from __future__ import annotations

import daemon  # noqa: F401 - says where the compiled loops are kept
from core.calibration.calibrate import calibrate
from core.measurement import measure_pair
from core.site import CheckerboardTarget
from drivers.sim.settings import Sensor, SimSettings
from drivers.sim.world import World
from tests.core.scenes import grey, head_positions, small_site
from tests.core.sessions import all_views

BOARD = CheckerboardTarget(11, 8, 4.0, 50.0)
"""Few corners; their squares are wide enough for the loops of wide squares too."""


def main() -> None:
    """Calibrate a small site on few views, and measure one pair, with images of 8 and of 16 bits.

    The zero of a calibration with the head is the mean of several looks, which has 16.
    """
    site = small_site(sub_target=BOARD)
    for bits in (8, 12):
        world = World(site, SimSettings(seed=3, sensor=Sensor(bits=bits)))
        calibration, _ = calibrate(all_views(world, 5, head_positions(site, 6)), site)
        main, sub = (grey(world, role, world.settings.start_utc) for role in ("main", "sub"))
        measure_pair(main, sub, site, calibration)


if __name__ == "__main__":
    main()
