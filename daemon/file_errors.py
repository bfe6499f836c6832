"""Errors of the operating system about a file, as one line: which file, what is wrong, the cure."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from daemon.user_names import group_name, user_name

SERVICE_USER = "dcam"
"""The user and the group that own the service's files."""


def file_error_text(error: OSError) -> str:
    """Give the line: the file, what the system says of it, and what to do."""
    reason = error.strerror or str(error)
    if not isinstance(error.filename, str | bytes | os.PathLike):
        cure = _general_cure(error.errno, "the disk in use")
        return reason if cure is None else f"{reason}; {cure}"
    path = Path(os.fsdecode(error.filename))
    cure = _cure(error.errno, path) or "check the path and its permissions"
    return f"{path}: {reason}; {cure}"


def _cure(number: int | None, path: Path) -> str | None:
    match number:
        case errno.ENOENT:
            return _missing(path)
        case errno.EACCES | errno.EPERM:
            return _not_allowed(path)
        case errno.EISDIR:
            return "it is a directory: name a file"
        case errno.ENOTDIR:
            return f"{_first_file(path)} is not a directory: name another path"
        case errno.EEXIST:
            return "name another path, or move what is there away"
    return _general_cure(number, str(_nearest(path)))


def _general_cure(number: int | None, where: str) -> str | None:
    match number:
        case errno.ENOSPC | errno.EDQUOT:
            return f"free space on {where} (df -h, df -i), or name a path on another disk"
        case errno.EROFS:
            return f"{where} is mounted read-only: name another path; dmesg says if the disk failed"
        case errno.EIO:
            return f"the disk under {where} fails: see dmesg, and copy what is on it"
        case errno.EMFILE | errno.ENFILE:
            return "too many files are open: close other programs, or raise ulimit -n"
    return None


def _missing(path: Path) -> str:
    if path.parent.is_dir():
        return "check its name" if path.suffix else f"check its name, or mkdir -p {path}"
    return f"there is no directory {path.parent}: check the path, or mkdir -p {path.parent}"


def _not_allowed(path: Path) -> str:
    """Say who may: the service's files are for its user, and readable for its group."""
    me = user_name(os.geteuid())
    try:
        found = _nearest(path).stat()
    except OSError:
        return f"{me} may not: check its permissions"
    owner = user_name(found.st_uid)
    if SERVICE_USER in {owner, group_name(found.st_gid)}:
        return (
            f"{me} may not: run the command as the service's user (sudo -u {SERVICE_USER} ...),"
            f" or to read only, join the group (sudo usermod --append --groups {SERVICE_USER}"
            f" {me}, then log in again)"
        )
    if os.geteuid() in {0, found.st_uid}:
        return f"{me} may not: check its permissions (ls -ld, lsattr -d), or name another path"
    sudo = "sudo" if owner == "root" else f"sudo -u {owner}"
    return (
        f"{me} may not, it belongs to {owner}: run the command as that user ({sudo} ...),"
        " or name another path"
    )


def _nearest(path: Path) -> Path:
    """The path, or the nearest directory above it that is there."""
    places = (path, *path.absolute().parents)
    return next((place for place in places if os.path.lexists(place)), path)


def _first_file(path: Path) -> Path:
    """The part of a path that is used as a directory, and is none."""
    return next((place for place in path.absolute().parents if place.is_file()), path)
