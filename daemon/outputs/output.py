"""What every output is to the sender, and how it fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from daemon.errors import HardwareError

if TYPE_CHECKING:  # commands that only need the error do not read rows
    from daemon.store.queries.arrivals import Arrival


class NotTakenError(HardwareError):
    """A server did not take rows: they are sent again."""

    def __init__(self, message: str, taken: int = 0) -> None:
        super().__init__(message)
        self.taken = taken
        """How many of the rows, from the first on, it did take."""


class Output(Protocol):
    """Where rows are sent."""

    name: str
    """Its table in the config."""
    history: bool
    """Whether it is to have what was recorded before it was set up."""
    batch: int
    """Rows that it is given together."""

    def send(self, rows: Sequence[Arrival], latest: Arrival | None) -> None:
        """Return when the server has acknowledged all rows. Raises NotTakenError.

        After that the same rows are given again, those that it took left out. `latest` is the row
        of the latest slot.
        """

    def close(self) -> None:
        """Say goodbye."""
