"""Who looks at the chunks: this process, a worker a core, or the workers of a scheduler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from daemon.errors import WorkFailedError
from daemon.reprocessing import cluster
from daemon.reprocessing.chunks import Chunk, Work, chunk_key, in_chunks, read_chunk, see_chunk
from daemon.reprocessing.frames import Frames, SeenSlot
from daemon.reprocessing.not_started import how_to_install_dask
from daemon.reprocessing.parts import Parts

LOCAL, SERIAL = "local", "serial"
WORTH_SHARING = 100
"""Slots from which workers are started: they need some seconds for it."""


@contextmanager
def seen_slots(
    work: Work,
    frames: Frames,
    count: int,
    scheduler: str | None,
    parts: Parts,
    tell: Callable[[str], None],
) -> Iterator[Iterator[SeenSlot]]:
    """Give what each slot shows, in order. Raises WorkFailedError, HardwareError, UsageError.

    The result of a chunk is the same bytes whoever looked at it.
    """
    chunks = in_chunks(frames.slots())
    chosen = _chosen(scheduler, count, tell)
    if chosen == SERIAL:
        yield _read(_seen_here(work, chunks, parts))
    elif chosen == LOCAL:
        with cluster.local_cluster(cluster.cores(), tell) as starting:
            yield _read(_seen_from_the_start(starting, work, chunks, parts, tell))
    else:
        with cluster.remote_cluster(chosen, tell) as client:
            cluster.check_workers(client, tell)
            yield _read(cluster.seen_by_workers(client, work, chunks, parts))


def _seen_from_the_start(
    starting: Future[Any],
    work: Work,
    chunks: Iterator[Chunk],
    parts: Parts,
    tell: Callable[[str], None],
) -> Iterator[bytes]:
    """Look at chunks here until the workers are up."""
    here = _seen_here(work, chunks, parts)
    while not starting.done():
        content = next(here, None)
        if content is None:
            return
        yield content
    client = starting.result()
    cluster.check_workers(client, tell)
    yield from cluster.seen_by_workers(client, work, chunks, parts)


def _chosen(scheduler: str | None, count: int, tell: Callable[[str], None]) -> str:
    has_dask = find_spec("distributed") is not None
    if scheduler == LOCAL and not has_dask:
        msg = f"--scheduler {LOCAL} needs dask: {how_to_install_dask()}"
        raise WorkFailedError(msg)
    if scheduler is not None:
        return scheduler
    if count < WORTH_SHARING:
        return SERIAL
    if cluster.cores() == 1:
        tell("measuring on one core: there is no other")
        return SERIAL
    if not has_dask:
        cure = how_to_install_dask()
        tell(f"measuring on one core of {cluster.cores()}; dask would use all: {cure}")
        return SERIAL
    return LOCAL


def _seen_here(work: Work, chunks: Iterator[Chunk], parts: Parts) -> Iterator[bytes]:
    digest = work.digest()
    for chunk in chunks:
        key = chunk_key(digest, chunk)
        content = parts.load(key)
        if content is None:
            content = see_chunk(work, chunk)
            parts.save(key, content)
        yield content


def _read(contents: Iterator[bytes]) -> Iterator[SeenSlot]:
    for content in contents:
        yield from read_chunk(content)
