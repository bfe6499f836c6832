"""Durable writes as named things: what has returned from here survives a power cut.

The limits: a disk that acknowledges a flush it has not done cannot be helped from here, and a
file system must order a rename before the directory sync that follows it (ext4, xfs and btrfs do).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def fsync_file(path: Path) -> None:
    """Force a file's content to the disk. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_directory(directory: Path) -> None:
    """Force a directory's entries (new names, renames, removals) to the disk. Raises OSError."""
    fsync_file(directory)


def make_directory_durable(directory: Path) -> None:
    """Make a directory and what is missing above it; every new name is synced in its parent."""
    if directory.is_dir():
        return
    make_directory_durable(directory.parent)
    directory.mkdir(exist_ok=True)
    fsync_directory(directory.parent)


def write_durable(path: Path, data: bytes) -> None:
    """Write a whole file: either the old one (or none) or the new one is there at any instant.

    Raises OSError.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a name to write to: temporary name, sync, rename, sync of the directory.

    When the block ends the file is there under its own name, whole and durable; when it raises, the
    old one (or none) still is. Raises OSError.
    """
    temporary = temporary_name(path)
    try:
        yield temporary
        fsync_file(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    fsync_directory(path.parent)


def temporary_name(path: Path) -> Path:
    """The name a file has until it is complete."""
    return path.with_name(f".{path.name}.tmp")


def append_durable(path: Path, data: bytes) -> None:
    """Append to an existing file and sync it. A cut may leave a part of `data`: end it in a mark.

    Raises OSError.
    """
    with path.open("ab") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
