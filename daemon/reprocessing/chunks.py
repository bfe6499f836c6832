"""Slots in chunks: what one process looks at, in whatever order, and hands back as bytes."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import threading
from collections.abc import Iterable, Iterator, MutableMapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import structlog

from core.site import Site
from daemon.errors import WorkFailedError
from daemon.reprocessing.frames import SeenSlot, SlotFrames, see_slot
from daemon.slots.identity import Identity, own_identity
from daemon.slots.measuring import ActiveCalibration

CHUNK_SLOTS = 20
"""A second or two of work, so that handing it out costs nothing beside it."""
_LOWER_PRIORITY = 10

Chunk = tuple[SlotFrames, ...]
Note = tuple[str, dict[str, Any]]
"""A line of the log: its level and what it says."""


@dataclass(frozen=True, slots=True)
class Work:
    """What all chunks are looked at with."""

    site: Site
    calibration: ActiveCalibration
    directory: Path | None
    """Where the frames are on this computer; None: at a URL."""

    def digest(self) -> str:
        """What, beside the frames, the result of a chunk hangs on, in this process."""
        given = json.dumps(self.calibration.calibration.to_dict(), sort_keys=True)
        text = repr((self.site, given, own_identity()))
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class SeenChunk:
    """A chunk's result, and what it was computed with."""

    identity: Identity
    content: bytes


def in_chunks(slots: Iterator[SlotFrames]) -> Iterator[Chunk]:
    """Cut slots into chunks, in order."""
    while chunk := tuple(islice(slots, CHUNK_SLOTS)):
        yield chunk


def see_chunk(work: Work, chunk: Chunk) -> bytes:
    """Look at a chunk's frames, its log in this process. Raises ArchiveError, StorageError."""
    seen = tuple(see_slot(frames, work.site, work.calibration) for frames in chunk)
    return pickle.dumps((seen, ()))


def see_chunk_elsewhere(work: Work, chunk: Chunk) -> SeenChunk:
    """Look at a chunk's frames in a worker; the lines of its log come back with the result.

    Raises WorkFailedError when the worker does not see the frames' directory; else as `see_chunk`.
    """
    if work.directory is not None and not work.directory.is_dir():
        msg = f"worker on {os.uname().nodename}: {work.directory} is not there; share it there, or "
        msg += "give the frames' URL with --from"
        raise WorkFailedError(msg)
    os.setpriority(os.PRIO_PROCESS, 0, max(os.getpriority(os.PRIO_PROCESS, 0), _LOWER_PRIORITY))
    with _kept_log() as notes:
        seen = tuple(see_slot(frames, work.site, work.calibration) for frames in chunk)
    return SeenChunk(own_identity(), pickle.dumps((seen, tuple(notes))))


def read_chunk(content: bytes) -> tuple[SeenSlot, ...]:
    """Give what a chunk showed, after saying what its log said."""
    # From our own workers, or of our own file (Parts).
    seen, notes = pickle.loads(content)  # noqa: S301
    log = structlog.get_logger("dcam.daemon")
    for level, fields in notes:
        getattr(log, level)(**fields)
    return tuple(seen)


_of_thread = threading.local()


def _keep(_logger: Any, level: str, fields: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    _of_thread.notes.append((level, dict(fields)))
    raise structlog.DropEvent


@contextmanager
def _kept_log() -> Iterator[list[Note]]:
    """Keep what this thread logs; for a worker, whose log nobody reads."""
    structlog.configure(
        processors=[structlog.processors.format_exc_info, _keep],
        logger_factory=structlog.ReturnLoggerFactory(),
    )
    _of_thread.notes = []
    yield _of_thread.notes


def chunk_key(digest: str, chunk: Chunk) -> str:
    """A name for a chunk's result: another one where its frames, or `digest`, differ."""
    files: Iterable[Any] = (path for frames in chunk for path in frames.files())
    states = [_state(path) for path in files if isinstance(path, Path)]
    return hashlib.sha256(repr((digest, chunk, states)).encode()).hexdigest()


def _state(path: Path) -> tuple[int, int] | None:
    try:
        there = path.stat()
    except OSError:
        return None
    return there.st_size, there.st_mtime_ns
