"""A computer whose cores are all busy, and a `dcamd` that has the priority of its unit there."""

from __future__ import annotations

import configparser
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

UNIT = Path(__file__).parents[1] / "systemd" / "dcamd.service"
COUNT = "while True: pass"


@contextmanager
def all_cores_busy() -> Iterator[None]:
    """Run a program that only counts on each core, each a user's: in a session of its own."""
    with ExitStack() as opened:
        for core in sorted(os.sched_getaffinity(0)):
            process = subprocess.Popen([sys.executable, "-c", COUNT], start_new_session=True)
            opened.callback(process.wait)
            opened.callback(process.kill)
            os.sched_setaffinity(process.pid, {core})
        yield


def unit_niceness() -> int:
    """Give what `dcamd.service` sets; its CPUWeight is the same in other numbers."""
    unit = configparser.ConfigParser(interpolation=None, strict=False)
    unit.read(UNIT)
    return unit.getint("Service", "Nice")


def give_priority(pid: int, niceness: int) -> None:
    """Put a process before or behind others, in its session and its session among others.

    `pid` must lead its session. Raises PermissionError for whoever is not root.
    """
    os.setpriority(os.PRIO_PROCESS, pid, niceness)
    group = Path(f"/proc/{pid}/autogroup")
    if group.exists():  # Linux shares between sessions first, whatever their processes' niceness
        group.write_text(str(niceness), encoding="ascii")
