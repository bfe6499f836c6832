"""The computer's own run: which boot, since when, and whether its clock is disciplined."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from daemon.clock.time_sync import Synchronisation
from drivers.protocols import Clock

BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")
BOOT_ID_VARIABLE = "DCAM_BOOT_ID"
"""Where systemd says which boot this is. A container has one of its own, but the /proc that the
service is locked in with (ProtectProc) shows it the host's: every cut would look like a crash."""


@dataclass(frozen=True, slots=True)
class Machine:
    """What a wrong wall clock leaves untouched."""

    boot_id: str
    """The kernel's name for this run of the machine: another one means it was off between."""
    uptime_s: Callable[[], float]
    """Gives the seconds since the boot, sleep included."""
    clock_synchronised: Callable[[], bool | None]
    """Tells whether something (NTP, PTP) disciplines the clock; None: it is not known."""


def this_machine() -> Machine:
    """The machine that this runs on."""
    return Machine(read_boot_id(), uptime_s, Synchronisation())


def simulated_machine(clock: Clock) -> Machine:
    """The one on whose stepped clock simulated time goes by."""
    return Machine(read_boot_id(), clock.monotonic_s, lambda: None)


def read_boot_id() -> str:
    """Give the name of this run of the machine, or of the container."""
    boot_id = os.environ.get(BOOT_ID_VARIABLE) or BOOT_ID_FILE.read_text(encoding="ascii")
    return str(UUID(boot_id.strip()))  # systemd writes it without its dashes


def uptime_s() -> float:
    """Seconds since the boot of the machine, sleep included (CLOCK_BOOTTIME, clock_gettime(2))."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
