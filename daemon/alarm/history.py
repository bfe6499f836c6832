"""What became of alarms: one line of JSON each in `alarm-history.jsonl`, bounded in size.

A line is appended and made durable, whole or not at all as far as a reader can tell: a line that a
power cut left incomplete is left out. What a full disk refuses goes to /run, and is read there.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from daemon.alarm.kept import give_to_owner, places
from daemon.status.item import Level
from daemon.times import instant_text

FILE_NAME = "alarm-history.jsonl"
MOST_BYTES = 2_000_000
"""Of one file; there are two, the older one ends in `.1`: about 20 000 entries in all."""
MOST_TEXT = 1000

Kind = Literal[
    "raised",
    "changed",
    "cleared",
    "contradicted",
    "sent",
    "failed",
    "acknowledged",
    "silenced",
    "silence_ended",
]


@dataclass(frozen=True, slots=True)
class Happened:
    """One entry."""

    time_utc: datetime
    kind: Kind
    name: str
    """Of the alarm; of several in a message, joined by commas."""
    level: Level = Level.OK
    text: str = ""
    by: str = ""
    """Who acknowledged or silenced; which receiver a message went to."""
    id: str = ""
    """Of the alarm, or the message."""

    def fields(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "time_utc": instant_text(self.time_utc),
            "kind": self.kind,
            "name": self.name,
            "level": self.level.name.lower(),
            "text": self.text[:MOST_TEXT],
            "by": self.by,
            "id": self.id,
        }


def note_history(state: Path, happened: Happened) -> bool:
    """Append an entry; False where neither disk nor /run takes it: an alarm never fails of that."""
    line = (json.dumps(happened.fields(), ensure_ascii=False) + "\n").encode()
    for path in reversed(places(state, FILE_NAME)):
        try:
            _append(path, line)
        except OSError:
            continue
        return True
    return False


def alarm_history(
    state: Path, since_utc: datetime | None = None, until_utc: datetime | None = None
) -> list[Happened]:
    """The entries of since <= time < until, in order of time; damaged lines are left out."""
    found = [
        one
        for path in reversed(places(state, FILE_NAME))
        for part in (path.with_name(f"{path.name}.1"), path)
        for one in _read(part)
        if (since_utc is None or one.time_utc >= since_utc)
        and (until_utc is None or one.time_utc < until_utc)
    ]
    return sorted(found, key=lambda one: one.time_utc)


def _append(path: Path, line: bytes) -> None:
    """Append one line durably, on a line of its own whatever is before it. Raises OSError."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o640)
    try:
        size = os.fstat(descriptor).st_size
        is_whole = size == 0 or os.pread(descriptor, 1, size - 1) == b"\n"
        data = line if is_whole else b"\n" + line
        written = os.write(descriptor, data)
        if written < len(data):
            os.ftruncate(descriptor, size)
            msg = "no room for a line"
            raise OSError(msg)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if size == 0:
        give_to_owner(path)
    if size + len(line) > MOST_BYTES:
        path.replace(path.with_name(f"{path.name}.1"))


def _read(path: Path) -> Iterator[Happened]:
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        return
    for line in lines:
        try:
            found = json.loads(line)
            yield Happened(
                time_utc=datetime.fromisoformat(found["time_utc"]),
                kind=found["kind"],
                name=str(found["name"]),
                level=Level[str(found["level"]).upper()],
                text=str(found["text"]),
                by=str(found["by"]),
                id=str(found["id"]),
            )
        except (ValueError, KeyError, TypeError):
            continue
