"""Why there are no workers on this computer, in one line: what, where, what to do."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

from daemon.errors import DcamError, HardwareError, WorkFailedError
from daemon.file_errors import file_error_text
from drivers.libraries import how_to_install

_LOADED = "daemon.reprocessing.of_workers"
_PATIENCE_S = 120.0
_ELSE = "--scheduler serial measures without workers"


def how_to_install_dask() -> str:
    """What to do in this installation to have it."""
    return how_to_install("dask", extra="dask", there="reprocess a copy of the frames")


def no_dask(error: ImportError) -> DcamError:
    """Say that dask is not there, or cannot be loaded."""
    return WorkFailedError(f"--scheduler needs dask ({error}): {how_to_install_dask()}")


def why_not_started(error: Exception) -> DcamError:
    """Say what kept the workers of this computer from starting.

    Dask says of most of it only that a nanny failed; the system's own error is behind that. A
    process that ended while it loaded left nothing: what it loads is loaded once more to see.
    """
    for cause in _causes(error):
        if isinstance(cause, ImportError):
            return no_dask(cause)
        if isinstance(cause, OSError) and cause.strerror:
            text = cause.strerror if cause.filename is None else file_error_text(cause)
            scratch = os.environ.get("TMPDIR", "/tmp")  # noqa: S108 - only named, not written to
            return HardwareError(
                f"no workers on this computer: {text}; they need a directory for files ({scratch}, "
                "TMPDIR names another), /dev/shm, the network address 127.0.0.1 and open files "
                f"(ulimit -n); {_ELSE}"
            )
    words = [sys.executable, "-c", f"import {_LOADED}"]
    ran = subprocess.run(  # noqa: S603 - this interpreter and a name of ours
        words, capture_output=True, text=True, timeout=_PATIENCE_S, check=False
    )
    if ran.returncode != 0:
        said = ran.stderr.strip().splitlines() or [f"it ended with {ran.returncode}"]
        return WorkFailedError(
            f"no workers on this computer: {_LOADED} cannot be loaded there: {said[-1]}; look at "
            f"PYTHONPATH, or install dcam again; {_ELSE}"
        )
    return WorkFailedError(
        "no workers on this computer: their processes end as they start "
        f"({type(error).__name__}: {error}); is there memory enough? {_ELSE}"
    )


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
