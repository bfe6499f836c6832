"""A head whose angles count from where the rig is aimed, not from the head's own zero."""

from __future__ import annotations

from drivers.protocols import HeadReport, PanTiltHead


class HomedHead:
    """A head with its home elsewhere than at its zero; implements `PanTiltHead`.

    `describe` stays in the head's own angles, as do its limits and its messages.
    """

    def __init__(self, head: PanTiltHead, home_deg: tuple[float, float]) -> None:
        self._head = head
        self._home_deg = home_deg

    @property
    def reports_position(self) -> bool:
        """Whether the head tells its angles."""
        return self._head.reports_position

    def move_to(self, pan_deg: float, tilt_deg: float) -> None:
        """Move to angles from home."""
        self._head.move_to(self._home_deg[0] + pan_deg, self._home_deg[1] + tilt_deg)

    def position_deg(self) -> tuple[float, float] | None:
        """Pan and tilt from home."""
        position = self._head.position_deg()
        if position is None:
            return None
        return position[0] - self._home_deg[0], position[1] - self._home_deg[1]

    def describe(self) -> HeadReport:
        """What the head says of itself, in its own angles."""
        return self._head.describe()

    def halt(self) -> None:
        """Stop all motion at once."""
        self._head.halt()

    def close(self) -> None:
        """Halt and release the port."""
        self._head.close()
