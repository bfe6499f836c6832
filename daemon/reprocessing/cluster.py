"""Chunks on dask.distributed: a cluster of this computer's cores, or one that is there."""

from __future__ import annotations

import logging
import os
import pickle
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import forkserver
from typing import Any, cast

from daemon.errors import DcamError, HardwareError, UsageError, WorkFailedError
from daemon.reprocessing.chunks import Chunk, SeenChunk, Work, chunk_key, see_chunk_elsewhere
from daemon.reprocessing.not_started import no_dask, why_not_started
from daemon.reprocessing.parts import Parts
from daemon.slots.identity import Identity, own_identity

_AHEAD = 2
"""Chunks in flight for each thread of the workers: one at work, one that waits. More would only
make a slow disk seek."""
_CONNECT_S = 10.0
ALONE_S = 120.0
"""Without any worker, before the run is ended. Chosen: a worker starts again in 5 to 30 s."""
_LOOK_S = 5.0
_TRIES = 3
"""Of a chunk whose storage does not answer."""

_OF_WORKERS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
"""A core each; and images in the memory that the C library keeps, as in a serial run."""
_FORKED_FROM = "daemon.reprocessing.forked_from"
_SETTINGS = {
    "distributed.worker.multiprocessing-method": "forkserver",
    "distributed.nanny.pre-spawn-environ": {},
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
"""Left to itself dask has each worker import everything by itself; has the C library hand all
memory back at once, which costs images a tenth of the time; looks at its workers 10 to 100 times a
second: a twentieth of a core; and tells whoever asks port 8787 of them."""

Tell = Callable[[str], None]


@contextmanager
def local_cluster(cores: int, tell: Tell) -> Iterator[Future[Any]]:
    """Start a worker a core on this computer; the client comes when they are up.

    All ends with the block. Raises HardwareError.
    """
    try:
        _start_fork_server()
    except OSError as error:
        raise why_not_started(error) from error
    with ExitStack() as opened, ThreadPoolExecutor(1, "start of workers") as starter:
        starting = starter.submit(_started, opened, cores)
        starting.add_done_callback(partial(_say_so, tell, cores))
        yield starting


def _say_so(tell: Tell, cores: int, starting: Future[Any]) -> None:
    if starting.exception() is None:
        tell(f"{cores} workers have started")


def _started(opened: ExitStack, cores: int) -> Any:
    """Start them, and give the client. Raises WorkFailedError, HardwareError."""
    try:
        return _cluster(opened, cores)
    except Exception as error:
        raise why_not_started(error) from error


def _cluster(opened: ExitStack, cores: int) -> Any:
    from dask import config
    from distributed import Client, LocalCluster, utils

    _silence()
    utils._forkserver_preload_set = True  # noqa: SLF001 - else it adds all that dask can use
    # Others on this computer must not hand in work: TLS, with keys that only this run has.
    options = {"dashboard_address": None, "silence_logs": logging.CRITICAL, "security": True}
    opened.enter_context(config.set(_SETTINGS))
    cluster = LocalCluster(n_workers=cores, threads_per_worker=1, host="127.0.0.1", **options)
    opened.callback(cluster.close)
    client = Client(cluster)
    opened.callback(client.close)  # not by `with`: another thread leaves it
    return client


def _start_fork_server() -> None:
    """Begin to import what workers need, in the process that they are forked from."""
    os.environ.update(_OF_WORKERS)
    forkserver.set_forkserver_preload([_FORKED_FROM])
    forkserver.ensure_running()


@contextmanager
def remote_cluster(address: str, tell: Tell) -> Iterator[Any]:
    """Connect to a scheduler. Raises HardwareError, UsageError."""
    try:
        from distributed import Client
    except ImportError as error:
        raise no_dask(error) from None
    _silence()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            client = Client(address, timeout=_CONNECT_S)
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError:
            msg = f"{address}: no worker has joined; start one: dask worker {address}"
            raise HardwareError(msg) from None
        except OSError as error:
            msg = f"{address}: no scheduler answers ({' '.join(str(error).split())[:120]}); start "
            msg += "one with: dask scheduler"
            raise HardwareError(msg) from None
        except (ValueError, TypeError) as error:  # no address, or of a kind that is not set up
            msg = f"--scheduler {address}: {error}; an address is tcp://host:8786"
            raise UsageError(msg) from None
    for one in warned:
        tell(f"warning: {' '.join(str(one.message).split())}")
    with client:
        yield client


def _silence() -> None:
    """What dask says of its connections is nothing to the user: what matters is an error here."""
    warnings.filterwarnings("ignore", category=UserWarning, module="distributed")
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)


def check_workers(client: Any, tell: Tell) -> None:
    """Require that all workers are of this process's versions. Raises WorkFailedError."""
    for worker, answer in client.run(own_identity, on_error="return").items():
        if isinstance(answer, BaseException):
            msg = f"worker {worker}: does not run dcam ({answer}); install it there, with dask"
            raise WorkFailedError(msg)
        _require_alike(answer, str(worker))
        if answer.processor != own_identity().processor:
            tell(
                f"warning: worker {worker} has another processor ({answer.processor} there, "
                f"{own_identity().processor} here): the last digits of values may differ"
            )


def _require_alike(identity: Identity, worker: str) -> None:
    different = own_identity().differences(identity)
    if different:
        msg = f"worker {worker}: {different}; values would differ: install the same versions"
        raise WorkFailedError(msg)


def seen_by_workers(
    client: Any, work: Work, chunks: Iterator[Chunk], parts: Parts
) -> Iterator[bytes]:
    """Give the chunks' results in order, at most `_AHEAD` for each thread in flight.

    What a worker that dies had to do is done by another. Raises WorkFailedError, HardwareError.
    """
    # A task, so that it can be made once more where workers that had it are lost.
    shared = client.submit(pickle.loads, pickle.dumps(work), pure=False)
    digest = work.digest()
    waiting: deque[tuple[str, Any]] = deque()
    for chunk in chunks:
        key = chunk_key(digest, chunk)
        known = parts.load(key)
        if known is None:
            known = client.submit(see_chunk_elsewhere, shared, chunk, pure=False, retries=_TRIES)
        waiting.append((key, known))
        while len(waiting) >= _AHEAD * max(sum(client.nthreads().values()), 1):
            yield _settled(client, *waiting.popleft(), parts)
    while waiting:
        yield _settled(client, *waiting.popleft(), parts)


def _settled(client: Any, key: str, known: Any, parts: Parts) -> bytes:
    """A chunk's result, kept for a run that goes on from here."""
    from distributed import KilledWorker

    if isinstance(known, bytes):
        return known
    try:
        seen = _awaited(client, known)
    except DcamError:
        raise
    except KilledWorker as error:
        msg = f"the same chunk ended one worker after another ({error}): is there memory enough?"
        raise WorkFailedError(msg) from error
    except Exception as error:
        msg = (
            f"the scheduler or its workers: {type(error).__name__}: {error}; run it again to go on"
        )
        raise HardwareError(msg) from error
    _require_alike(seen.identity, "one that joined later")
    parts.save(key, seen.content)
    return seen.content


def _awaited(client: Any, future: Any) -> SeenChunk:
    """Wait for a chunk, as long as there are workers. Raises HardwareError, and what it raised."""
    alone_since_s: float | None = None
    while True:
        try:
            return cast("SeenChunk", future.result(timeout=_LOOK_S))
        except TimeoutError:
            if client.nthreads():
                alone_since_s = None
                continue
        alone_since_s = alone_since_s or time.monotonic()
        if time.monotonic() - alone_since_s > ALONE_S:
            msg = f"no worker is left since {ALONE_S:g} s; start some, and run it again to go on"
            raise HardwareError(msg)


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))
