"""Where an alarm keeps what it has sent: beside the database, or in /run while the disk is ill."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import ValidationError

from daemon.alarm.rules import Memory
from daemon.durable import write_durable

FILE_NAME = "alarm.json"


def read_memory(state: Path) -> tuple[Memory, str | None]:
    """Give what was kept last, and what was wrong with it: a broken memory is an empty one."""
    for path in _places(state):
        try:
            return Memory.model_validate_json(path.read_bytes()), None
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            return Memory(), f"{path}: cannot be read ({error.strerror}): begun again from nothing"
        except ValidationError:
            return Memory(), f"{path}: damaged: begun again from nothing"
    return Memory(), None


def keep_memory(state: Path, memory: Memory) -> None:
    """Keep it durably; on a disk that refuses, until the next start of the computer at least.

    Else a disk that turned read-only would be reported at every look. Raises OSError.
    """
    *stopgap, path = _places(state)
    data = memory.model_dump_json().encode() + b"\n"
    try:
        write_durable(path, data)
    except OSError:
        if not stopgap:
            raise
        write_durable(stopgap[0], data)
    else:
        for older in stopgap:
            older.unlink(missing_ok=True)


def _places(state: Path) -> list[Path]:
    """Newest first. systemd names a directory in /run, which lasts from look to look."""
    runtime = os.environ.get("RUNTIME_DIRECTORY")
    places = [Path(runtime) / FILE_NAME] if runtime else []
    return [*places, state / FILE_NAME]
