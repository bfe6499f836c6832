"""A look at both cameras over some minutes: what only the real camera knows.

Its lines are what a first report from real hardware should hold: both spellings of the serial
number, the camera's clock beside ours, exposure steps, order of bytes, what could not be set, and
what another program had left.
"""

from __future__ import annotations

import itertools
import logging
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daemon.checks.finding import Finding, failed
from daemon.config.reading import Config, Installation
from daemon.devices import open_clock, open_pair_source
from daemon.errors import DcamError
from daemon.lock import sole_writer
from daemon.version import VERSION
from drivers.errors import DeviceError, DriverError
from drivers.genicam.serial_number import as_on_usb
from drivers.protocols import CapturedFrame, CapturedPair, Clock, FramePairSource, Role

N_PAIRS = 20
SPAN_S = 133.0
"""Longer than 128 s, after which the clock of some FLIR cameras may begin again (IEEE 1394's)."""
EXPOSURES_US = (1000.0, 1234.5, 2500.0, 5000.0)
"""Asked for in turns, to see the camera's steps."""
ODD_RATE = 1e-3
"""A camera's clock off by more is no clock in ns."""
ROLES: tuple[Role, Role] = ("main", "sub")
SAYINGS = {
    "camera_setting_not_applied": "not set: {reason}",
    "camera_setting_differs": "{feature} is {actual}, {wanted} was asked for",
    "camera_left_by_another": "left on by another program, now put right: {found}",
    "camera_byte_order": "sends the high byte of deep pixels first: {high_byte_first}",
    "camera_clock_went_back": "its clock went back, from {before_s:.3f} to {now_s:.3f} s",
    "stale_frame_refused": "an old frame came once more: {frame_id}",
    "camera_lost": "was lost: {error}",
}
"""Events of the drivers that belong into the report, and how it puts them."""


@dataclass(slots=True)
class _Look:
    pairs: list[CapturedPair] = field(default_factory=list)
    asked_us: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    events: list[Mapping[str, Any]] = field(default_factory=list)


def check_long(site: Installation) -> Iterator[Finding]:
    """Take pairs over SPAN_S, with cameras that nobody else has open."""
    try:
        with sole_writer(site.state_directory, "dcam-ctl check --long"):
            clock = open_clock(site.config)
            with closing(open_pair_source(site.config, clock)) as source:
                look = _take(source, clock)
    except (DriverError, DcamError, OSError) as error:
        yield failed("long", error)
        return
    yield Finding("versions", "ok", _versions())
    yield Finding(
        "long pairs",
        "warning" if look.failures else "ok",
        f"{len(look.pairs)} of {N_PAIRS} over {SPAN_S:.0f} s"
        + "".join(f"; {failure}" for failure in look.failures),
    )
    for role in ROLES:
        yield from _of_camera(role, site.config, look)


def _take(source: FramePairSource, clock: Clock) -> _Look:
    look = _Look()
    with _events(look.events):
        for k in range(N_PAIRS):
            exposure_us = EXPOSURES_US[k % len(EXPOSURES_US)]
            for role in ROLES:
                source.set_exposure(role, exposure_us, None)
            try:
                look.pairs.append(source.capture(clock.now_utc().replace(microsecond=0)))
                look.asked_us.append(exposure_us)
            except DeviceError as error:
                look.failures.append(str(error))
            if k + 1 < N_PAIRS:
                clock.pause(SPAN_S / (N_PAIRS - 1))
    return look


@contextmanager
def _events(into: list[Mapping[str, Any]]) -> Iterator[None]:
    """Collect what the drivers log meanwhile."""

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if isinstance(record.msg, dict):
                into.append(record.msg)

    logger, collector = logging.getLogger("dcam.drivers"), Collector()
    logger.addHandler(collector)
    try:
        yield
    finally:
        logger.removeHandler(collector)


def _of_camera(role: Role, config: Config, look: _Look) -> Iterator[Finding]:
    serial = str(config.camera.of(role).serial)
    yield Finding(f"{role} serial", "ok", as_on_usb(serial))
    frames = [pair.main if role == "main" else pair.sub for pair in look.pairs]
    if len(frames) > 1:
        yield _camera_clock(f"{role} clock", frames)
        steps = {
            f"{asked:g} -> {'not reported' if f.exposure_us is None else f'{f.exposure_us:.3f}'}"
            for asked, f in zip(look.asked_us, frames, strict=True)
        }
        yield Finding(f"{role} exposure", "ok", f"us: {', '.join(sorted(steps))}")
    said = _said(serial, role, look.events)
    yield Finding(f"{role} reports", "warning" if said else "ok", "; ".join(said) or "nothing odd")


def _camera_clock(name: str, frames: list[CapturedFrame]) -> Finding:
    """Compare the camera's clock with ours, from frame to frame."""
    steps = [
        (
            1e-9 * (b.camera_time_ns - a.camera_time_ns),
            b.trigger_monotonic_s - a.trigger_monotonic_s,
        )
        for a, b in itertools.pairwise(frames)
    ]
    back = [(camera_s, ours_s) for camera_s, ours_s in steps if camera_s <= 0.0]
    if back:
        jumps = ", ".join(f"{camera_s - ours_s:+.3f} s" for camera_s, ours_s in back)
        text = f"went back {len(back)} times in {len(steps)}: {jumps}; frames count by number"
        return Finding(name, "warning", text)
    camera_s, ours_s = (sum(step[i] for step in steps) for i in (0, 1))
    rate = camera_s / ours_s - 1.0 if ours_s else 0.0
    odd = max(abs(camera - ours) for camera, ours in steps)
    unsure = 2.0 * odd / ours_s if ours_s else 0.0  # our own times may be late by odd at both ends
    text = f"{round(1e6 * rate):+d} ppm beside ours over {ours_s:.0f} s, {1e3 * odd:.1f} ms at most"
    return Finding(name, "ok" if abs(rate) < ODD_RATE + unsure else "warning", text)


def _versions() -> str:
    """What was run: dcam, Python, the kernel, and the libraries on the way to the cameras."""
    mapped = re.findall(r"/(lib(?:aravis|usb-1)\S*)", Path("/proc/self/maps").read_text("utf-8"))
    python, kernel = platform.python_version(), platform.release()
    parts = [f"dcam {VERSION}", f"Python {python}", f"Linux {kernel}", *sorted(set(mapped))]
    return ", ".join(parts)


def _plain(value: object) -> object:
    """A camera's features with their values, as people write them."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {one}" for name, one in value.items())
    return value


def _said(serial: str, role: Role, events: list[Mapping[str, Any]]) -> list[str]:
    """What the driver logged of a camera, each once."""
    lines = []
    for event in events:
        words = SAYINGS.get(str(event.get("event")))
        mine = event.get("serial") == serial or event.get("role") == role
        mine |= serial in str(event.get("reason", ""))
        if words is not None and mine:
            lines.append(words.format_map({name: _plain(value) for name, value in event.items()}))
    return list(dict.fromkeys(lines))
