"""Compile every loop, for those who come after: a program, which reads its own results in silence.

Processes that start at the same time would each compile them by itself, which takes a minute.
"""

from __future__ import annotations

import daemon  # noqa: F401 - says where the compiled loops are kept
from drivers.sim.settings import SimSettings
from tests.core.sessions import session

DISTANCE_MM = 11000.0


def main() -> None:
    """Calibrate a small site on few views, and measure one pair."""
    made = session(DISTANCE_MM, SimSettings(seed=3), lens=5, rig=6)
    made.rows(1)


if __name__ == "__main__":
    main()
