"""The simulated pan-tilt head: it truncates to counts, as a real one does, and moves the rig."""

from __future__ import annotations

import math

from drivers.errors import HeadLimitError
from drivers.protocols import HeadReport
from drivers.sim.world import World


class SimulatedHead:
    """A pan-tilt head; implements `drivers.protocols.PanTiltHead`. Moves take no time."""

    reports_position = True

    def __init__(self, world: World) -> None:
        self._world = world
        self._model = world.settings.head
        self._counts = (0, 0)

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        """Go there, to the count below. Raises HeadLimitError beyond a limit, before any motion."""
        self._require_within("pan", pan_deg, self._model.limit_pan_deg)
        self._require_within("tilt", tilt_deg, self._model.limit_tilt_deg)
        per_deg = 3600.0 / self._model.arcsec_per_count
        self._counts = (math.trunc(pan_deg * per_deg), math.trunc(tilt_deg * per_deg))
        self._world.turn_head(*self.position_deg())

    def position_deg(self) -> tuple[float, float]:
        """Pan and tilt by the counts reached."""
        deg = self._model.arcsec_per_count / 3600.0
        return self._counts[0] * deg, self._counts[1] * deg

    def describe(self) -> HeadReport:
        """What a head says of itself."""
        pan, tilt = self._model.limit_pan_deg, self._model.limit_tilt_deg
        return HeadReport(
            "simulated head", self.position_deg(), ((-pan, pan), (-tilt, tilt)), power=None
        )

    def halt(self) -> None:
        """Stop; a simulated move is over already."""

    def close(self) -> None:
        """Release nothing."""

    def _require_within(self, axis: str, angle_deg: float, limit_deg: float) -> None:
        if not abs(angle_deg) <= limit_deg:  # also refuses NaN
            msg = (
                f"simulated head: {axis} {angle_deg:g} deg is beyond its limit of "
                f"+-{limit_deg:g} deg; ask for less"
            )
            raise HeadLimitError(msg)
