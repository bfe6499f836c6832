"""What is looked at before a database is opened: whether it is there, and sound."""

from __future__ import annotations

from pathlib import Path

from daemon.durable import make_directory_durable
from daemon.errors import (
    TO_SALVAGE,
    DatabaseDamagedError,
    DatabaseUnwritableError,
)
from daemon.store.salvage.damage import Depth, find_damage, traces_of_a_lost_database
from daemon.store.sqlite import FILE_NAME, database_exists, existing_path, undo_half_made


def database_bytes(directory: Path) -> int:
    """The size of the database of a state directory; 0 as long as there is none."""
    try:
        return (directory / FILE_NAME).stat().st_size
    except OSError:
        return 0


def path_for_writing(directory: Path, *, create: bool, checked: bool) -> Path:
    """Make a state directory ready for its database, and give the database's path.

    Its newest rows are looked at, unless it was `checked` before. Raises DatabaseMissingError,
    DatabaseDamagedError, DatabaseUnwritableError.
    """
    path = directory / FILE_NAME
    undo_half_made(path)
    exists = database_exists(path) if create else existing_path(directory).exists()
    if not exists and not checked and (traces := traces_of_a_lost_database(path)):
        msg = f"{path}: missing beside {traces}: {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    try:
        make_directory_durable(directory)
    except OSError as error:
        msg = f"{directory}: cannot be made ({error.strerror}): check the path and its permissions"
        raise DatabaseUnwritableError(msg) from error
    if exists and not checked and (found := find_damage(path, Depth.NEWEST)):
        msg = f"{path}: damaged ({found}): {TO_SALVAGE}"
        raise DatabaseDamagedError(msg)
    return path
