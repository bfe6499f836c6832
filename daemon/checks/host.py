"""This computer as its kernel tells it, in files below /sys, /proc, /dev and /etc."""

from __future__ import annotations

import os
import pwd
from dataclasses import dataclass
from pathlib import Path

from daemon.user_names import user_name

ROOT = Path("/")
"""Where those files are; tests make up a computer elsewhere."""
SERVICE_USER = "dcam"


def path(name: str) -> Path:
    """Give the path of a file of the kernel, as `sys/class/net`."""
    return ROOT / name


def text(where: Path) -> str | None:
    """Give what such a file says; None if it is not there or has no answer."""
    try:
        return where.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def number(where: Path) -> int | None:
    """Give the number in such a file; None if there is none."""
    said = text(where)
    try:
        return None if said is None else int(said)
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class Person:
    """Somebody who may open devices or not."""

    name: str
    uid: int
    gids: frozenset[int]

    def may_use(self, device: Path) -> bool:
        """Tell whether the mode of a device lets this one read and write. Raises OSError."""
        there = device.stat()
        if self.uid == 0:
            return True
        wanted = 0o6
        if there.st_uid == self.uid:
            wanted = 0o600
        elif there.st_gid in self.gids:
            wanted = 0o060
        return there.st_mode & wanted == wanted


def whoever_runs_dcamd() -> Person:
    """The service's user, if root asks and there is one, else whoever asks."""
    if os.geteuid() != 0:
        return Person(
            user_name(os.geteuid()), os.geteuid(), frozenset({*os.getgroups(), os.getegid()})
        )
    try:
        entry = pwd.getpwnam(SERVICE_USER)
    except KeyError:
        return Person("root", 0, frozenset())
    gids = os.getgrouplist(entry.pw_name, entry.pw_gid)
    return Person(entry.pw_name, entry.pw_uid, frozenset(gids))
