"""One writer for one state directory: a lock that the kernel releases when its holder dies."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from daemon.durable import make_directory_durable
from daemon.errors import AlreadyRunningError, HardwareError
from daemon.user_names import user_name

LOCK_NAME = "dcamd.lock"


def require_owner(state: Path) -> None:
    """Raise HardwareError for root in another user's state: that user could not write any more.

    Others are kept out by the directory's permissions.
    """
    if os.geteuid() != 0 or not state.is_dir() or (owner := state.stat().st_uid) == 0:
        return
    name = user_name(owner)
    msg = (
        f"{state} is {name}'s, who could not write to what root leaves there;"
        f" runuser -u {name} -- dcam-ctl ..."
    )
    raise HardwareError(msg)


@contextmanager
def sole_writer(state: Path, program: str = "dcamd") -> Iterator[None]:
    """Hold a state directory while the cameras are used and slots are written.

    Whoever takes pairs takes this lock. Raises AlreadyRunningError when another does,
    HardwareError for root in another user's directory.
    """
    require_owner(state)
    make_directory_durable(state)
    path = state / LOCK_NAME
    # The file stays: unlinking it would let two holders lock two files of the same name.
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
            msg = f"{state}: in use by {holder or 'another dcamd'}; stop it or give another --state"
            raise AlreadyRunningError(msg) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{program} (pid {os.getpid()})\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)
