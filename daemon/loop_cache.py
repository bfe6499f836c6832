"""Where Numba keeps its compiled loops, so that a program does not compile them at every start."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

SHARED = Path("/var/cache/dcam")
"""Of the service's user, who runs the calibration too; as in dcamd.service."""


def loop_cache(environ: Mapping[str, str] = os.environ, shared: Path = SHARED) -> str | None:
    """Give a directory for NUMBA_CACHE_DIR; None leaves Numba to its own choice.

    Numba chooses the folder of the source or the home directory; where neither can be written to,
    as for the user of a monitoring system, it would compile them at every start.
    """
    if "NUMBA_CACHE_DIR" in environ:
        return None
    if _is_ours(shared):
        return str(shared / "numba")
    home = Path(environ.get("HOME", "/"))
    choices = (Path(__file__).parents[1] / "core", home / ".cache", home)
    if any(os.access(choice, os.W_OK | os.X_OK) for choice in choices):
        return None
    import tempfile  # `status` is asked every minute, and mostly does not come here

    try:
        private = Path(tempfile.gettempdir()) / f"dcam-{os.geteuid()}"
        private.mkdir(mode=0o700, exist_ok=True)
        # What lies there is run as a program: never from a directory that somebody else has made.
        return str(private) if _is_ours(private) else tempfile.mkdtemp(prefix="dcam-")
    except OSError:  # every disk is full, or read-only
        return None


def _is_ours(directory: Path) -> bool:
    try:
        there = directory.lstat()
    except OSError:
        return False
    return directory.is_dir() and not directory.is_symlink() and there.st_uid == os.geteuid()
