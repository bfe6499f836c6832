"""Who else on this computer may reach for the serial port of the pan-tilt head.

ModemManager sends AT commands to ports that it takes for a modem's; brltty takes USB adapters of
some kinds away from the kernel, for a braille display.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from daemon.checks import host
from daemon.checks.finding import Finding
from daemon.config.reading import Config
from drivers.heads.port_name import is_network

IGNORED = "E:ID_MM_DEVICE_IGNORE=1"
"""How udev notes, in its file of a device, that ModemManager is to leave it alone."""
CURES = {
    "ModemManager": (
        "ModemManager runs and may send AT commands to the head: systemctl disable --now"
        " ModemManager; where a modem needs it, have udev set ID_MM_DEVICE_IGNORE for the head's"
        " adapter, as 60-dcam.rules does for usual ones"
    ),
    "brltty": (
        "brltty runs and takes USB serial adapters for a braille display; the port vanishes:"
        " apt-get remove brltty (or systemctl mask --now brltty brltty-udev); replug the adapter"
    ),
}


def check_port_rivals(config: Config) -> Iterator[Finding]:
    """Name each running program that may take the head's port, with its cure."""
    port = config.pan_tilt.port
    if not config.pan_tilt.is_serial or port is None or is_network(port):
        return
    running = _running()
    rivals = [name for name in CURES if name in running]
    if "ModemManager" in rivals and _is_left_alone(Path(port)):
        rivals.remove("ModemManager")
    for name in rivals:
        yield Finding("head port", "warning", f"{port}: {CURES[name]}")
    if not rivals:
        yield Finding("head port", "ok", f"{port}: no program runs that would take it")


def _running() -> set[str]:
    """The names of all processes."""
    return {host.text(path) or "" for path in host.path("proc").glob("[1-9]*/comm")}


def _is_left_alone(port: Path) -> bool:
    """Whether udev has marked the port so that ModemManager does not touch it."""
    try:
        number = port.stat().st_rdev
    except OSError:
        return False
    name = f"run/udev/data/c{os.major(number)}:{os.minor(number)}"
    return IGNORED in (host.text(host.path(name)) or "").splitlines()
