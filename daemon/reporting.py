"""What the world is told of the daemon's course: phases, and each cycle that has ended.

The watchdog is fed here and nowhere else, by finished cycles only: a slot that hangs in a library
feeds nothing, and the service manager starts a fresh process.
"""

from __future__ import annotations

from datetime import datetime

from daemon.notify import Notifier
from daemon.pipeline import Missed
from daemon.store.records import MeasurementRecord
from daemon.store.times import slot_text


class Reporter:
    """Tells the service manager what the daemon does and what became of each slot."""

    def __init__(self, notifier: Notifier) -> None:
        self._notifier = notifier

    def recovering(self) -> None:
        """What the last daemon left is being made whole."""
        self._notifier.status("recovering")

    def ready(self) -> None:
        """Start-up is over: the next slot will be taken."""
        self._notifier.ready()

    def stopping(self) -> None:
        """The daemon ends its slot and closes."""
        self._notifier.stopping()

    def slot_done(self, slot_utc: datetime, outcome: MeasurementRecord | Missed) -> None:
        """A cycle has ended: its slot has a row, or is owed to a gap."""
        if isinstance(outcome, Missed):
            state = f"missed: {outcome.cause.value}"
        else:
            state = f"done: {outcome.measurement.flag.name.lower()}"
        self._notifier.alive(f"slot {slot_text(slot_utc)} {state}")

    def late_row_done(self, slot_utc: datetime) -> None:
        """A pair that was left without its row has been measured."""
        self._notifier.alive(f"slot {slot_text(slot_utc)} measured late")
