"""What the daemon reports of its course: phases, and each cycle that has ended.

The watchdog is fed here and nowhere else, by finished cycles only: a slot that hangs in a library
feeds nothing, and the service manager starts a fresh process.
"""

from __future__ import annotations

import os
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import structlog

from daemon.clock.machine import read_boot_id, uptime_s
from daemon.control.notify import Notifier
from daemon.control.run_state import LastSlot, LostCamera, RunState, write_run_state
from daemon.slots.pipeline import Missed
from daemon.store.records import GapCause, MeasurementRecord
from daemon.times import instant_text, slot_text
from daemon.version import VERSION

_log = structlog.get_logger("dcam.daemon")

PERIODS_OF_PATIENCE = 3
MARGIN_S = 120.0
"""Beyond the periods and the burst: cameras that hang until their deadlines, a database that waits
for its lock, a row and its frames on a slow disk."""
START_S = 300.0
CHECKED_BYTES_A_S = 5e6
"""How fast a database is at least checked, copied and migrated on a slow disk."""
LATE_ROW_S = 120.0


class Reporter:
    """Tells the service manager, and whoever reads the file, what the daemon does.

    It may be called from several threads, and never raises.
    """

    def __init__(self, notifier: Notifier, directory: Path | None = None) -> None:
        """`directory` is where the file goes; None: nowhere."""
        self._notifier = notifier
        self._directory = directory
        self._lock = threading.Lock()
        self._refused = ""
        self._state = RunState(
            pid=os.getpid(),
            boot_id=read_boot_id(),
            version=VERSION,
            started_utc=instant_text(datetime.now(UTC)),
        )

    def opening(self, database_bytes: int) -> None:
        """The database is being checked, and migrated if need be: a large one takes its time."""
        self._notifier.start_takes(START_S + database_bytes / CHECKED_BYTES_A_S)
        self._tell()

    def salvaging(self, done: int, total: int) -> None:
        """A damaged database is being saved, page by page."""
        text = f"database damaged, saving what can be read: page {done} of {total}"
        self._notifier.status(text)
        self._notifier.start_takes(START_S)
        self._tell(reason=text)

    def recovering(self) -> None:
        """What the last daemon left is being made whole."""
        self._notifier.status("recovering")
        self._notifier.start_takes(START_S)
        self._tell(phase="recovering", reason="")

    def running(self, period_s: int, burst_s: float = 0.0) -> None:
        """The next slot will be taken; from now on a cycle that takes too long is a hang."""
        patience_s = PERIODS_OF_PATIENCE * period_s + burst_s + MARGIN_S
        self._tell(phase="running", period_s=period_s, patience_s=patience_s)
        self._notifier.cycles_take(patience_s)
        self._notifier.ready()

    def paused(self, reason: str | None) -> None:
        """Slots are not taken for this reason, or are again for None."""
        phase = self._state.phase
        if phase in {"running", "paused"}:
            self._tell(phase="paused" if reason else "running", reason=reason or "")

    def stopping(self) -> None:
        """The daemon ends its slot and closes."""
        self._tell(phase="stopping", reason="")
        self._notifier.stopping()

    def slot_done(self, slot_utc: datetime, outcome: MeasurementRecord | Missed) -> None:
        """A cycle has ended: its slot has a row, or is owed to a gap."""
        slot = slot_text(slot_utc)
        if isinstance(outcome, Missed):
            self._tell_missed(slot, outcome)
            self._notifier.alive(f"slot {slot} missed: {outcome.cause.value}")
            return
        flag = outcome.measurement.flag.name.lower()
        self._tell(last=LastSlot(slot, flag), failed_in_a_row=0, lost={})
        self._notifier.alive(f"slot {slot} done: {flag}")

    def late_row_done(self, slot_utc: datetime) -> None:
        """A pair that was left without its row has been measured."""
        self._notifier.alive(f"slot {slot_text(slot_utc)} measured late")
        if self._state.phase == "recovering":
            self._notifier.start_takes(LATE_ROW_S)
        self._tell()

    def _tell_missed(self, slot: str, missed: Missed) -> None:
        last = LastSlot(slot, "missed", missed.cause.value, missed.detail)
        if missed.cause is GapCause.CALIBRATION:
            self._tell(last=last)
            return
        before = self._state.lost
        lost = {
            role: LostCamera(before[role].since if role in before else slot, missed.detail)
            for role in missed.cameras
        }
        self._tell(last=last, failed_in_a_row=self._state.failed_in_a_row + 1, lost=lost)

    def _tell(self, **changes: object) -> None:
        with self._lock:
            self._state = replace(self._state, reported_s=uptime_s(), **changes)  # type: ignore[arg-type]
            if self._directory is None:
                return
            try:
                write_run_state(self._directory, self._state)
            except OSError as error:
                if self._refused != str(error):  # said once, not at every slot
                    _log.warning("state_not_written", error=str(error))
                self._refused = str(error)
            else:
                self._refused = ""
