"""What is done about an error while dcamd runs: one table, from the class of the error to a policy.

Nothing here is retried faster than a back-off: the next slot is a period away, a camera is opened
again after a pause that grows (`drivers.pair`), and a process that ends is started again by systemd
after `RestartSec`. What a fresh process is hoped to cure ends this one, after some patience; the
patience doubles with every such end of the last day, so that a fault that stays costs few slots.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from daemon.errors import (
    ArchiveError,
    DatabaseDamagedError,
    DcamError,
    DiskFullError,
    ExitCode,
    SlotTakenError,
    StoreError,
)
from daemon.store.records import GapCause
from daemon.text import count_of
from drivers.errors import (
    DeviceHangsError,
    DeviceLostError,
    DriverError,
    FrameTimeoutError,
    IncompleteFrameError,
    SettingRefusedError,
)

PROCESS_SPENT = "process_spent"
"""The event of a process that ended because a fresh one may help."""
MOST_DOUBLINGS = 9
"""Of a patience: 3 slots become a day and more, at one slot a minute."""


class Action(StrEnum):
    """What is done about an error, besides telling it."""

    RETRY = "retry"
    """Once more at once, in the same slot, if it came soon enough."""
    NEXT_SLOT = "next_slot"
    """The slot is missed; the next one is a fresh attempt."""
    REOPEN = "reopen"
    """The slot is missed; the device is opened again, after a pause that grows."""
    DEGRADE = "degrade"
    """Go on with less: frames are given up before the row is."""
    OWE = "owe"
    """The slot is recorded, from its frames if they were kept, once the database takes it."""
    EXIT = "exit"
    """The process ends with the error's exit code; systemd starts a fresh one, which recovers."""


class ProcessSpentError(DcamError):
    """Slot after slot has failed, and a new process may do better."""


class DevicesSpentError(ProcessSpentError):
    """A camera's library hangs in this process."""

    exit_code: ClassVar[ExitCode] = ExitCode.HARDWARE


class DatabaseSpentError(ProcessSpentError):
    """The database is damaged; the next process salvages it at its start."""

    exit_code: ClassVar[ExitCode] = ExitCode.DATABASE


@dataclass(frozen=True, slots=True)
class Policy:
    """What is done about one class of errors."""

    error: type[Exception]
    action: Action
    cause: GapCause
    """What the gap of the slot says."""
    patience: int | None = None
    """So many slots in a row may end so; then the process ends. None: there is no such number."""
    ends_with: type[ProcessSpentError] = ProcessSpentError
    """The error that ends it, which owns the exit code."""


POLICIES = (
    # Cameras
    Policy(IncompleteFrameError, Action.RETRY, GapCause.CAPTURE_FAILED),
    Policy(FrameTimeoutError, Action.NEXT_SLOT, GapCause.CAMERA_LOST),
    Policy(SettingRefusedError, Action.REOPEN, GapCause.CAPTURE_FAILED),
    Policy(DeviceHangsError, Action.REOPEN, GapCause.CAMERA_LOST, 30, DevicesSpentError),
    Policy(DeviceLostError, Action.REOPEN, GapCause.CAMERA_LOST),
    Policy(DriverError, Action.NEXT_SLOT, GapCause.CAPTURE_FAILED),
    # Disk and database
    Policy(DiskFullError, Action.OWE, GapCause.DISK_FULL),
    Policy(ArchiveError, Action.DEGRADE, GapCause.STORAGE_FAILED),
    Policy(DatabaseDamagedError, Action.EXIT, GapCause.STORAGE_FAILED, 1, DatabaseSpentError),
    Policy(SlotTakenError, Action.NEXT_SLOT, GapCause.STORAGE_FAILED),
    Policy(StoreError, Action.OWE, GapCause.STORAGE_FAILED),
    # What nobody foresaw
    Policy(MemoryError, Action.EXIT, GapCause.UNKNOWN, 1),
    Policy(Exception, Action.NEXT_SLOT, GapCause.UNKNOWN, 3),
)
"""The first that fits counts. Errors of the start (config, another dcamd, a library that is not
installed) end the process at once, with the exit codes of `daemon.errors`."""

INTERNAL = POLICIES[-1]
"""Of what nobody foresaw."""


def policy_of(error: Exception) -> Policy:
    """Give the policy of an error."""
    return next(policy for policy in POLICIES if isinstance(error, policy.error))


@dataclass(slots=True)
class Circuit:
    """Counts slots that fail in a row, and ends the process when its patience is over."""

    ended_before: int = 0
    """How often a process has ended so within the last day."""
    failed: int = 0
    """Slots in a row that failed for the same reason, which has a limit."""
    _policy: Policy | None = None

    def slot_ended(self, policy: Policy | None, detail: str = "") -> None:
        """Note how a slot ended, None is well. Raises ProcessSpentError at the end of patience."""
        if policy is None or policy.patience is None:
            self.failed, self._policy = 0, None
            return
        self.failed = self.failed + 1 if policy is self._policy else 1
        self._policy = policy
        if self.failed < policy.patience << min(self.ended_before, MOST_DOUBLINGS):
            return
        msg = (
            f"{count_of(self.failed, 'slot')} in a row failed ({detail}); a new process may succeed"
        )
        raise policy.ends_with(msg)
