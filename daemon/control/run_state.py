"""What dcamd is doing now, in a file that anyone may read: `/run/dcam/state.json`.

It is written after every cycle and at every change, whole or not at all, and is not made durable:
`/run` is memory, and after a crash nobody needs it. A directory that is full or missing costs the
file, never a slot. The database is the record; this is only the present.
"""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

from daemon.config.model import DEFAULT_STATE_DIRECTORY

RUNTIME_DIRECTORY = Path("/run/dcam")
FILE_NAME = "state.json"
SCHEMA = 1
MOST_BYTES = 100_000

Phase = Literal["starting", "recovering", "running", "paused", "stopping"]


@dataclass(frozen=True, slots=True)
class LostCamera:
    """A camera that gave no frame when it was last asked for one."""

    since: str
    """The first slot without its frame."""
    error: str
    """What it said last."""


@dataclass(frozen=True, slots=True)
class LastSlot:
    """The slot that ended last, and what became of it."""

    slot: str
    outcome: str
    """The flag of its row in words, or `missed`."""
    cause: str = ""
    detail: str = ""


@dataclass(frozen=True, slots=True)
class RunState:
    """What one dcamd says of itself."""

    pid: int
    boot_id: str
    version: str
    started_utc: str
    phase: Phase = "starting"
    reason: str = ""
    """Why it is paused."""
    period_s: int | None = None
    patience_s: float | None = None
    """A cycle that takes longer than this hangs."""
    reported_s: float = 0.0
    """Seconds since the boot at which this was written."""
    last: LastSlot | None = None
    failed_in_a_row: int = 0
    """Slots without a row, since the last that had one; a pause does not count."""
    lost: dict[str, LostCamera] = field(default_factory=dict)
    """By role; a camera that is not in it gave its last frame, or was not asked yet."""


def runtime_directory(state: Path) -> Path:
    """Where socket and file of a state directory are: in memory, so that no disk can fail them.

    /run/dcam for the default one, for another a folder in it; else, where dcamd does not run as a
    service or may not write there, the state directory itself.
    """
    if state == DEFAULT_STATE_DIRECTORY:
        return RUNTIME_DIRECTORY
    own = _folder_of(state)
    return own if own.is_dir() else state


def make_runtime_directory(state: Path) -> Path:
    """Give the directory, made if /run/dcam is there: systemd makes that one."""
    if state != DEFAULT_STATE_DIRECTORY and RUNTIME_DIRECTORY.is_dir():
        with suppress(OSError):
            _folder_of(state).mkdir(exist_ok=True)
    return runtime_directory(state)


def _folder_of(state: Path) -> Path:
    return RUNTIME_DIRECTORY / hashlib.sha256(os.fsencode(state.resolve())).hexdigest()[:16]


def write_run_state(directory: Path, state: RunState) -> None:
    """Replace the file. Raises OSError."""
    temporary = directory / f".{FILE_NAME}.tmp"
    try:
        temporary.write_text(json.dumps({"schema": SCHEMA, **asdict(state)}), encoding="utf-8")
        temporary.replace(directory / FILE_NAME)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_run_state(directory: Path) -> RunState | None:
    """Give what the last dcamd wrote, of whatever age; None where there is nothing to read."""
    try:
        with (directory / FILE_NAME).open("rb") as file:
            found = json.loads(file.read(MOST_BYTES))
        return _understood(found)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _understood(found: dict[str, Any]) -> RunState:
    """Take what this version knows. Raises ValueError, TypeError, KeyError, AttributeError."""
    known = {name.name: found[name.name] for name in fields(RunState) if name.name in found}
    if found["schema"] != SCHEMA or known["phase"] not in get_args(Phase):
        raise ValueError
    if known.get("last") is not None:
        known["last"] = LastSlot(**{key: str(value) for key, value in known["last"].items()})
    known["lost"] = {
        role: LostCamera(str(lost["since"]), str(lost["error"]))
        for role, lost in known.get("lost", {}).items()
    }
    known["reported_s"] = float(known["reported_s"])
    known["failed_in_a_row"] = int(known["failed_in_a_row"])
    return RunState(**known | {"pid": int(known["pid"])})


def is_alive(state: RunState, boot_id: str) -> bool:
    """Tell whether the process that wrote this may still run."""
    if state.boot_id != boot_id:
        return False
    try:
        os.kill(state.pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
