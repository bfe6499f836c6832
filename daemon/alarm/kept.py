"""Small files that outlive a look: beside the database, or in /run while the disk is ill."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from daemon.config.model import DEFAULT_STATE_DIRECTORY
from daemon.durable import write_durable

_Kept = TypeVar("_Kept", bound=BaseModel)

RUNTIME_DIRECTORY = Path("/run/dcam-alarm")
"""What systemd makes for dcam-alarm.service; it lasts from look to look."""


def places(state: Path, name: str) -> list[Path]:
    """Where a file may be, newest first."""
    named = Path(os.environ.get("RUNTIME_DIRECTORY", ""))
    if named.name == RUNTIME_DIRECTORY.name:  # the page's unit has another
        return [named / name, state / name]
    if state == DEFAULT_STATE_DIRECTORY and RUNTIME_DIRECTORY.is_dir():
        return [RUNTIME_DIRECTORY / name, state / name]
    return [state / name]


def read_kept(state: Path, name: str, model: type[_Kept]) -> tuple[_Kept, str | None]:
    """Give what was kept last, and what was wrong with it: a broken file is an empty one."""
    for path in places(state, name):
        try:
            return model.model_validate_json(path.read_bytes()), None
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            return model(), f"{path}: cannot be read ({error.strerror}): begun again from nothing"
        except ValidationError:
            return model(), f"{path}: damaged: begun again from nothing"
    return model(), None


def keep(state: Path, name: str, content: BaseModel) -> None:
    """Keep it durably; on a disk that refuses, until the next start of the computer at least.

    Else a disk that turned read-only would be reported at every look. Raises OSError.
    """
    *stopgap, path = places(state, name)
    data = content.model_dump_json().encode() + b"\n"
    try:
        write_durable(path, data)
        give_to_owner(path)
    except OSError:
        if not stopgap:
            raise
        write_durable(stopgap[0], data)
        give_to_owner(stopgap[0])
    else:
        for older in stopgap:
            with suppress(OSError):
                older.unlink(missing_ok=True)


def give_to_owner(path: Path) -> None:
    """Let a file that root wrote be the directory's owner's, who writes it the next time."""
    if os.geteuid() == 0:
        owner = path.parent.stat()
        os.chown(path, owner.st_uid, owner.st_gid)


@contextmanager
def only_one(state: Path, name: str, *, wait: bool) -> Iterator[bool]:
    """Hold a lock while the block runs; False: another has it.

    Where no lock can be made, on a full disk say, the block runs without it.
    """
    for path in reversed(places(state, name)):
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
            break
    else:
        yield True
        return
    try:
        with suppress(OSError):
            give_to_owner(path)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
    finally:
        os.close(descriptor)
