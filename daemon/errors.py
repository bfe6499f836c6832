"""Errors of the daemon: each class owns its one-line message and its exit code.

Exit codes: 0 done, 1 the work failed, 2 usage, 3 config, 4 hardware or I/O, 5 database.
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar


class ExitCode(IntEnum):
    """Exit codes of every command but `status`."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    CONFIG = 3
    HARDWARE = 4
    DATABASE = 5


class DcamError(Exception):
    """Base of the errors the daemon layer raises on purpose; the message is one line."""

    exit_code: ClassVar[ExitCode] = ExitCode.FAILED


class WorkFailedError(DcamError):
    """The command ran, and could not do or find what it was asked for."""


class UsageError(DcamError):
    """The options given do not go together, or name something that cannot be used."""

    exit_code: ClassVar[ExitCode] = ExitCode.USAGE


class ConfigError(DcamError):
    """The config cannot be used; one line for each thing wrong in it."""

    exit_code: ClassVar[ExitCode] = ExitCode.CONFIG

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class HardwareError(DcamError):
    """A device, a file, a disk or another program prevents the work."""

    exit_code: ClassVar[ExitCode] = ExitCode.HARDWARE


class AlreadyRunningError(HardwareError):
    """Another dcamd holds this state directory."""


TO_SALVAGE = "restart dcamd, it sets the file aside and saves what can be read"
"""What to do about damage."""


class StoreError(DcamError):
    """The database could not do what was asked; nothing of the request was written."""

    exit_code: ClassVar[ExitCode] = ExitCode.DATABASE


class DatabaseMissingError(StoreError):
    """There is no database in the state directory."""


class DatabaseNewerError(StoreError):
    """The database was written by a newer version of this program."""


class DatabaseOlderError(StoreError):
    """The database waits for a migration, and this opener may not run it."""


class DatabaseDamagedError(StoreError):
    """The file is not a SQLite database, or its pages contradict each other."""


class DatabaseRemovedError(DatabaseDamagedError):
    """The file was removed, renamed or replaced while it was open; what is open still has all."""


class DatabaseForeignError(StoreError):
    """A sound SQLite database, but of another program."""


class DamagedRowError(Exception):
    """A row is not what was written: within the store only, it leaves as DatabaseDamagedError."""


class DatabaseBusyError(StoreError):
    """Another process held the write lock for longer than the busy time-out."""


class DatabaseUnwritableError(StoreError):
    """The disk is read-only or failing, or the file may not be written."""


class DiskFullError(StoreError):
    """There is no space left for a row or a frame."""


class ArchiveError(StoreError):
    """A frame could not be written to the archive, for another reason than space."""

    exit_code: ClassVar[ExitCode] = ExitCode.HARDWARE


class CopyError(StoreError):
    """A copy of the database could not be written where it was wanted."""

    exit_code: ClassVar[ExitCode] = ExitCode.HARDWARE


class SlotTakenError(StoreError):
    """The slot already has a row or a stored pair; what was measured is never overwritten."""


def error_of(exit_code: ExitCode, text: str) -> DcamError:
    """Give the error of another process: of the class that owns its exit code."""
    if exit_code is ExitCode.CONFIG:
        return ConfigError(*text.splitlines())
    owners: dict[ExitCode, type[DcamError]] = {
        ExitCode.USAGE: UsageError,
        ExitCode.HARDWARE: HardwareError,
        ExitCode.DATABASE: StoreError,
    }
    return owners.get(exit_code, WorkFailedError)(text)
