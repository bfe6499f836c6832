"""Chunks that are done, kept beside the output, so that an interrupted run goes on from there."""

from __future__ import annotations

import hashlib
import os
import shutil
from contextlib import suppress
from pathlib import Path

from daemon.errors import WorkFailedError

_DIGEST_BYTES = hashlib.sha256().digest_size


class Parts:
    """Results by the name of their chunk; without a directory nothing is kept."""

    def __init__(self, output: Path | None) -> None:
        """Make the directory of an output. Raises WorkFailedError, OSError."""
        self.found = 0
        self.directory = None if output is None else output.parent / f".{output.name}.parts"
        if self.directory is None:
            return
        self.directory.mkdir(mode=0o700, exist_ok=True)
        there = self.directory.lstat()
        # What lies there is unpickled: never from a directory that somebody else may write to.
        if self.directory.is_symlink() or there.st_uid != os.geteuid() or there.st_mode & 0o022:
            msg = f"{self.directory}: not a directory of yours alone; remove it, or name another "
            msg += "--output"
            raise WorkFailedError(msg)

    def load(self, key: str) -> bytes | None:
        """A chunk's result; None where it is not there whole."""
        if self.directory is None:
            return None
        try:
            data = (self.directory / key).read_bytes()
        except OSError:
            return None
        digest, content = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
        if hashlib.sha256(content).digest() != digest:
            return None
        self.found += 1
        return content

    def save(self, key: str, content: bytes) -> None:
        """Keep a chunk's result. Raises OSError."""
        if self.directory is None:
            return
        temporary = self.directory / f"{key}.tmp"
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
        temporary.replace(self.directory / key)

    def remove(self) -> None:
        """The output is there: forget how it came about."""
        if self.directory is not None:
            with suppress(OSError):
                shutil.rmtree(self.directory)
