"""Errors of database and frame archive, in one line: which file, what is wrong, what to do."""

from __future__ import annotations

from typing import ClassVar

TO_SALVAGE = "restart dcamd, it sets the file aside and saves what can be read"
"""What to do about damage."""


class StoreError(Exception):
    """The database could not do what was asked; nothing of the request was written."""

    exit_code: ClassVar[int] = 5


class DatabaseMissingError(StoreError):
    """There is no database in the state directory."""


class DatabaseNewerError(StoreError):
    """The database was written by a newer version of this program."""


class DatabaseOlderError(StoreError):
    """The database waits for a migration, and this opener may not run it."""


class DatabaseDamagedError(StoreError):
    """The file is not a SQLite database, or its pages contradict each other."""


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

    exit_code = 4


class SlotTakenError(StoreError):
    """The slot already has a row or a stored pair; what was measured is never overwritten."""
