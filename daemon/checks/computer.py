"""The site's computer: its heat, its watchdog, its clocks, and the service on it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from daemon.checks import host
from daemon.checks.finding import Finding, unless
from daemon.clock.time_sync import clock_is_synchronised
from daemon.user_names import user_name

MARGIN_C = 10.0
"""Nearer to the temperature at which a computer slows down or stops is too near for a summer."""
USUAL_LIMIT_C = 85.0
"""Of a zone that names no limit of its own."""
CAMERA_LIMIT_C = 65.0
"""Industrial cameras are specified to about this, at the sensor's board."""
WRONG_S = 60.0


def check_computer() -> Iterator[Finding]:
    """Look at what the kernel tells of the machine."""
    yield _heat()
    yield _watchdog()
    yield from _battery_clock()
    yield from _service()


def _heat() -> Finding:
    zones = [
        (temperature_c - limit_c, temperature_c, limit_c, kind)
        for zone in sorted(host.path("sys/class/thermal").glob("thermal_zone*"))
        for kind, temperature_c, limit_c in _zone(zone)
    ]
    if not zones:
        return Finding("computer", "ok", "tells no temperature")
    excess_c, temperature_c, limit_c, kind = max(zones)
    text = f"{kind} at {temperature_c:.0f} °C, its limit is {limit_c:.0f} °C"
    cure = "clean its fan and filter, give the cabinet air or shade"
    return unless(excess_c < -MARGIN_C, "computer", text, cure)


def _zone(zone: Path) -> Iterator[tuple[str, float, float]]:
    """Name, temperature and lowest limit; nothing of a zone that has no sensor."""
    thousandths = host.number(zone / "temp")
    if thousandths is None or thousandths <= 0:
        return
    limits = [
        limit
        for kind in zone.glob("trip_point_*_type")
        if host.text(kind) in {"critical", "hot", "passive"}
        and (limit := host.number(zone / kind.name.replace("_type", "_temp"))) is not None
        and limit > 0
    ]
    limit_c = min(limits) / 1e3 if limits else USUAL_LIMIT_C
    yield host.text(zone / "type") or zone.name, thousandths / 1e3, limit_c


def check_camera_heat(pair: Mapping[str, Any]) -> Iterator[Finding]:
    """Look at the cameras' own temperatures, where they tell them; a pair as `look` gives it."""
    for role in ("main", "sub"):
        temperature_c = pair[role]["temperature_c"]
        if temperature_c is not None:
            text = f"{temperature_c:.0f} °C, at most {CAMERA_LIMIT_C:.0f} °C"
            cure = "give it shade, air and a plate that carries the heat away"
            yield unless(temperature_c < CAMERA_LIMIT_C, f"{role} heat", text, cure)


def _watchdog() -> Finding:
    devices = sorted(host.path("sys/class/watchdog").glob("watchdog*"))
    if not devices:
        cure = "modprobe softdog; to keep it, echo softdog > /etc/modules-load.d/softdog.conf"
        return Finding("watchdog", "warning", f"none, a kernel that hangs stays so: {cure}")
    fed = [device for device in devices if host.text(device / "state") == "active"]
    device = (fed or devices)[0]
    name = host.text(device / "identity") or device.name
    cure = (
        "nobody feeds it, a kernel that hangs stays so: set RuntimeWatchdogSec=60 in"
        " /etc/systemd/system.conf.d/watchdog.conf (install.md), then systemctl daemon-reexec"
    )
    return unless(
        bool(fed), "watchdog", f"{name} {'restarts a hung kernel' if fed else 'is there'}", cure
    )


def _battery_clock() -> Iterator[Finding]:
    """What the time will be after a power cut, until something synchronises it."""
    said_s = host.number(host.path("sys/class/rtc/rtc0/since_epoch"))
    if said_s is None:
        return
    off_s = said_s - time.time()
    text = f"{off_s:+.0f} s from the system's"
    cure = "hwclock --systohc --utc; if it comes back after a power cut, change the battery"
    yield unless(abs(off_s) < WRONG_S, "battery clock", text, cure)


def _service() -> Iterator[Finding]:
    """Whether dcamd comes back with the computer, and whether the right user asks."""
    units = [
        host.path(directory) / "dcamd.service"
        for directory in (
            "etc/systemd/system",
            "usr/local/lib/systemd/system",
            "lib/systemd/system",
        )
    ]
    if any(unit.exists() for unit in units):
        wanted = host.path("etc/systemd/system/multi-user.target.wants/dcamd.service")
        starts = os.path.lexists(wanted)
        text = "starts with the computer" if starts else "does not start with the computer"
        yield unless(starts, "service", text, "systemctl enable dcamd")


def check_user(state: Path) -> Finding:
    """Whoever asks should be who runs dcamd, or what he may open says nothing of it."""
    person = host.whoever_runs_dcamd()
    if os.geteuid() == 0 and person.uid != 0:
        cure = f"runuser -u {person.name} -- dcam-ctl check --hardware shows what dcamd may do"
        return Finding("user", "warning", f"root may open what {person.name} may not: {cure}")
    there = next(path for path in (state, *state.parents) if path.exists())
    owner = there.stat().st_uid
    if there == state and owner != os.geteuid():
        text = f"{person.name}, but {state} is another user's: runuser -u {user_name(owner)}"
        return Finding("user", "warning", f"{text} -- dcam-ctl check --hardware")
    return Finding("user", "ok", person.name)


def check_clock(*, simulated: bool) -> Finding:
    """Whether something disciplines the machine's clock."""
    if simulated:
        return Finding("clock", "ok", "simulated")
    answer = clock_is_synchronised()
    if answer:
        return Finding("clock", "ok", "synchronised")
    text = "whether it is synchronised is not known" if answer is None else "not synchronised"
    cure = (
        "apt-get install chrony, or timedatectl set-ntp true; where there is one, chronyc sources"
        " or timedatectl timesync-status tells why it reaches no server"
    )
    return Finding("clock", "warning", f"{text}: {cure}")
