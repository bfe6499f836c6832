"""A note beside the database: of damage that somebody met, or of a salvage that has begun."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from daemon.durable import fsync_directory, write_durable

NOTE_NAME = "dcam.db.damage"
SET_ASIDE = "dcam.db.damaged-"
"""What the names of databases set aside begin with."""
COMPANIONS = ("-wal", "-shm", "-journal")
"""What SQLite keeps beside a database, by the ends of the names."""


@dataclass(frozen=True, slots=True)
class Note:
    """What the next start of dcamd must know."""

    why: str
    aside: str | None = None
    """The name that the database is set aside under, once that has begun."""


def note_damage(directory: Path, why: str) -> None:
    """Have the next start of dcamd look at everything, because of what was met. Raises OSError."""
    if read_note(directory) is None:
        write_note(directory, Note(" ".join(why.split())))


def read_note(directory: Path) -> Note | None:
    """What was noted; a note that cannot be understood still is one. Raises OSError."""
    try:
        text = (directory / NOTE_NAME).read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return Note(**json.loads(text))
    except (ValueError, TypeError):
        return Note("noted before")


def write_note(directory: Path, note: Note) -> None:
    """Write a note durably, over another. Raises OSError."""
    write_durable(directory / NOTE_NAME, (json.dumps(asdict(note)) + "\n").encode())


def clear_note(directory: Path) -> None:
    """The damage is dealt with, or there was none. Raises OSError."""
    (directory / NOTE_NAME).unlink(missing_ok=True)
    fsync_directory(directory)


def databases_set_aside(directory: Path) -> list[Path]:
    """The damaged databases that still lie in a state directory, oldest first."""
    found = directory.glob(f"{SET_ASIDE}*")
    return sorted(path for path in found if not path.name.endswith(COMPANIONS))
